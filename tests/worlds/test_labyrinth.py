"""The labyrinth: the table that comes with the mice's plans, what mice did in it, and the way to the water."""

import csv
from pathlib import Path

import torch

from neuroprior import oracle, read_plans
from neuroprior.worlds import labyrinth

DATA = Path(__file__).parents[2] / "eval" / "data" / "labyrinth"


def table() -> torch.Tensor:
    rows = list(csv.DictReader((DATA / "next_state.csv").open()))
    assert [int(row["node"]) for row in rows] == list(range(127))
    return torch.tensor([[int(row[move]) for move in labyrinth().action_names] for row in rows])


def test_the_table_is_that_of_the_data():
    assert torch.equal(labyrinth().next_state, table())


def test_what_mice_did_is_possible():
    world, plans = labyrinth(), read_plans(DATA / "plans.jsonl")
    assert plans.actions.shape == (190, 500)
    node, action = plans.context, plans.actions.long()
    assert world.legal_actions(node.flatten()).gather(1, action.flatten()[:, None]).all()
    assert torch.equal(world.next_state[node, action][:, :-1], node[:, 1:])


def test_moves_that_a_node_does_not_have():
    world = labyrinth()
    assert world.legal_actions(torch.arange(127)).sum(1).tolist() == [4] + [3] * 62 + [1] * 64


def test_water_is_found_by_the_shortest_way():
    world = labyrinth()
    # from the first junction six moves in; from any node at most six out and six in
    assert oracle(world, torch.tensor([0]), 5, objective="return").tolist() == [0]
    assert oracle(world, torch.tensor([0]), 6, objective="return").tolist() == [1]
    everywhere = torch.arange(127)
    assert oracle(labyrinth(absorbing=True), everywhere, 12, objective="return").tolist() == [
        float(node != 116) for node in range(127)
    ]


def test_water_comes_once_where_it_absorbs():
    for absorbing, drinks in ((True, 0), (False, 1)):
        world = labyrinth(absorbing=absorbing)
        state, reward = world.step(torch.tensor([57]), torch.tensor([int(world.next_state[57, 1] == 116)]))
        assert (state.item(), reward.item()) == (116, 1)
        assert float(oracle(world, state, 2, objective="return")) == drinks
