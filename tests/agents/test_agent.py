"""Agents: they do what their planner says, learn from what they did and from nothing else, and go on after a pause."""

import json
import re
from functools import cache

import pytest
import torch

from eval.live.foraging import ForagingWorld, patches
from neuroprior import (
    CombinedPrior,
    ExhaustivePlanner,
    GRUPrior,
    MarkovPrior,
    Plans,
    SamplingPlanner,
    TabularWorld,
    UniformPrior,
    World,
    gridworld,
    load,
    save,
)
from neuroprior.agents import Agent, checkpoints, restore_agent, save_agent
from neuroprior.planners import execute
from neuroprior.priors import AdaptivePrior, MixturePrior
from neuroprior.puzzles import AStarPlanner
from neuroprior.worlds import EpisodicWorld
from tests.support.sources import every_plan, refuses, seeded, stochastic_world

TRAINING = {"max_steps": 4, "progress": False}


def foraging(period=100):
    table = gridworld(6, 6, edges="torus")
    return ForagingWorld(table, patches(table, 3, 1, seeded(0)), period, 3)


def sampler(prior, length=6, num_plans=8, **more):
    return SamplingPlanner(prior, length, num_plans, objective="return", discount=0.9, **more)


def agent(prior=None, world=None, number=5, seed=1, planner=None, **more):
    prior, world = prior or MarkovPrior(4, 2), world or foraging()
    settings = {"replan_every": 2, "change": world.regrow, "learn_every": 12, "plan_length": 6, "retention": 0.9} | more
    return Agent(
        world, planner or sampler(prior), prior, world.reset(number, seeded(7)), generator=seeded(seed), **settings
    )


def test_without_learning_and_warm_starts_it_executes():
    world, prior = foraging(), UniformPrior(4)
    one = agent(prior, world, learn_every=None, warm_start=False)
    done = one.run(10)
    due = execute(sampler(prior), world, world.reset(5, seeded(7)), 10, 2, seeded(1), world.regrow)
    for name in ("actions", "rewards", "states"):
        assert torch.equal(getattr(done, name), getattr(due, name))
    assert done.model_steps == due.model_steps == 5 * 48
    assert torch.equal(one.state, done.states[:, -1])
    assert one.time == 10


def test_an_adaptive_prior_counts_each_stored_plan_and_is_never_fitted(tmp_path):
    """Earlier counts fade at each time at which another prior would be fitted."""
    base = MarkovPrior(4, 1)
    prior = AdaptivePrior(base, [float("inf"), 3.0, 1.0])
    one = agent(prior, number=3, retention=0.75)
    due, stored = torch.zeros(16, 4), []
    for time in (6, 12, 18, 24):
        stored.append(one.run(6).actions)
        counts = torch.zeros(16, 4)
        for plan in stored[-1].tolist():
            for before, last, action in zip(plan, plan[1:], plan[2:], strict=False):
                counts[4 * before + last, action] += 1
        due = due * (1 if time % 12 else 0.75) + counts
        assert prior.earlier_2.allclose(due)
    assert not base.has_learned
    save_agent(one, tmp_path)
    new = agent(AdaptivePrior(MarkovPrior(4, 1), [float("inf"), 3.0, 1.0]), number=3, retention=0.75)
    again = restore_agent(new, tmp_path)
    assert again.prior.earlier_2.equal(prior.earlier_2)


@pytest.mark.parametrize("num_rollouts", [1, 3])
def test_in_a_stochastic_world_both_are_rolled_out_so_often(num_rollouts):
    world, prior = stochastic_world(0), UniformPrior(3)
    planner = SamplingPlanner(prior, 4, 5)
    one = Agent(world, planner, prior, replan_every=2, learn_every=None, num_rollouts=num_rollouts, generator=seeded(0))
    alone = planner.plan(world, one.state, seeded(0)).model_steps
    assert one.run(6).model_steps == 3 * alone + 2 * (4 + 2 * num_rollouts * 4)


class Line(World):
    """Cells 0 to 9, of which the last is the goal; actions go back and forth."""

    num_actions, has_goal = 2, True

    def reset(self, number, generator=None):
        return torch.randint(10, (number,), generator=generator)

    def step(self, state, action, generator=None):
        return torch.where(state == 9, state, (state + 2 * action.long() - 1).clamp(0, 9)), torch.zeros(len(state))

    def solved(self, state):
        return state == 9

    def terminated(self, state):
        return state == 9

    def dip(self, state):
        """What is left, too low in 4: a short search goes there, and finds nothing better."""
        return torch.where(state == 4, 1, 9 - state).float()


def test_plans_that_end_by_themselves_are_executed_as_they_are():
    """Those of best-first searches: with a warm start as without, and from each start as from it alone."""
    world = type("Left", (Line,), {"reset": lambda self, number, generator=None: torch.full((number,), 9)})()

    def run(starts, max_nodes, steps, **more):
        searcher = AStarPlanner(world.dip, max_nodes=max_nodes)
        one = Agent(
            world, searcher, UniformPrior(2), torch.tensor(starts), learn_every=None, generator=seeded(0), **more
        )
        return one.run(steps)

    together = run([2, 7, 0], 50, 8)
    cold = run([2, 7, 0], 50, 8, warm_start=False)
    assert together.states[:, -1].tolist() == [9, 9, 8]
    assert (together.actions.equal(cold.actions), together.model_steps) == (True, cold.model_steps)
    for number, start in enumerate([2, 7, 0]):
        assert run([start], 50, 8).states[0].equal(together.states[number])
    for starts in ([2], [2, 0]):  # after two steps one of them is in the dip
        with refuses("replan_every", "a plan has fewer, 0"):
            run(starts, 3, 5)
    jumping = {"change": lambda state, _: torch.full_like(state, 9)}
    assert run([2], 50, 2, **jumping).states.unique().tolist() == [9]


def rhythm():
    """Eight cells in a circle; action `cell % 4` is rewarded, any other costs as much, and all lead on."""
    cell = torch.arange(8)
    reward = 2 * torch.nn.functional.one_hot(cell % 4, 4).float() - 1
    return TabularWorld(((cell + 1) % 8)[:, None].expand(8, 4), reward[None])


def test_the_rest_of_the_last_plan_begins_where_the_agent_stopped():
    """One perfect plan of six actions, and from then on nothing but a random one each time: the agent keeps to it."""
    world, state = rhythm(), torch.arange(5)
    planner = ExhaustivePlanner(6, objective="return")
    one = Agent(world, planner, UniformPrior(4), state, replan_every=2, learn_every=None, generator=seeded(0))
    begun = one.run(2)
    one.planner = SamplingPlanner(UniformPrior(4), 6, 1, objective="return")
    done = torch.cat([begun.actions, one.run(2).actions], 1)
    assert torch.equal(done, (state[:, None] + torch.arange(4)) % 4)


def test_after_the_end_of_the_last_plan_its_prior_goes_on():
    """A plan that ends after four actions, of which two are left; the prior nearly always takes action 3."""
    world, prior = rhythm(), MarkovPrior(4, 0).fit(torch.full((10_000, 6), 3))
    world.reward[0, 4:] = -1.0
    planner = ExhaustivePlanner(6, objective="return", any_prefix=True)
    state = torch.zeros(1, dtype=torch.long)
    one = Agent(world, planner, prior, state, replan_every=2, learn_every=None, generator=seeded(0))
    one.run(2)
    world.reward[0, 4:, 3] = 1.0
    one.planner = SamplingPlanner(UniformPrior(4), 6, 1, objective="return", any_prefix=True)
    assert one.run(4).actions.tolist() == [[2, 3, 3, 3]]


def test_it_learns_from_what_it_did():
    """All that was executed, cut into plans of six: a prior that is fitted to it is what the agent has learned."""
    one = agent(retention=1.0)
    done = one.run(36)
    plans = done.actions.view(5, 6, 6).transpose(0, 1).flatten(0, 1)
    assert torch.equal(one.replay.plans.actions.long(), plans)
    due = MarkovPrior(4, 2).fit(Plans(plans, 4))
    assert torch.equal(one.prior.log_prob(every_plan(4, 3)), due.log_prob(every_plan(4, 3)))


class Pupil(MarkovPrior):
    """Keeps the plans and settings of each fit."""

    fit_settings = ("strength",)

    def __init__(self, *given):
        super().__init__(*given)
        self.fits = []

    def fit(self, plans, *, generator=None, **settings):
        self.fits.append((plans, generator, settings))
        return super().fit(plans)


def test_what_a_fit_is_given():
    """The agent's generator and settings, and what is left of all plans so far: about 0.5, 0.75 and 0.875 as many."""
    prior = Pupil(4, 1)
    one = agent(prior, number=400, learn_every=6, retention=0.5, training={"strength": 3})
    one.run(18)
    kept = [0.5, 0.75, 0.875]
    assert len(prior.fits) == 3
    for (plans, generator, settings), share in zip(prior.fits, kept, strict=True):
        assert generator is one.generator
        assert settings == {"strength": 3}
        # Six standard errors of a binomial share at most.
        assert abs(len(plans) - 400 * share) < 6 * (400 * share) ** 0.5
    assert len(prior.fits[0][0]) < 300


def test_it_learns_only_so_often(monkeypatch):
    """After 12, 24 and 36 steps, from all that was executed so far."""
    one, sizes = agent(retention=1.0), []
    monkeypatch.setattr(one.prior, "fit", lambda plans, **_: sizes.append(len(plans)))
    one.run(36)
    assert sizes == [10, 20, 30]
    alone = agent(number=1, learn_every=6, retention=1.0)
    monkeypatch.setattr(alone.prior, "fit", lambda plans, **_: sizes.append(len(plans)))
    alone.run(18)
    assert sizes[3:] == [2, 3]  # a single plan is not learned from


@pytest.mark.parametrize("per", ["plan", "step"])
def test_it_stores_what_it_observed(per):
    prior, world = MarkovPrior(4, 1, num_contexts=36), foraging()
    prior.context_per = per
    one = agent(prior, world, retention=1.0)
    start = one.state
    done = one.run(24)
    cells = torch.cat([start[:, None], done.states[:, :-1]], 1)[..., 0].view(5, 4, 6).transpose(0, 1).flatten(0, 1)
    assert torch.equal(one.replay.plans.context, cells if per == "step" else cells[:, :1].expand_as(cells))
    assert prior.context_per == per


def test_it_stores_only_what_was_rewarded():
    one = agent(retention=1.0, min_score=0.0)
    done = one.run(60)
    rewarded = done.rewards.view(5, 10, 6).sum(2).T.flatten() > 0
    assert 0 < int(rewarded.sum()) < 50
    plans = done.actions.view(5, 10, 6).transpose(0, 1).flatten(0, 1)
    assert torch.equal(one.replay.plans.actions.long(), plans[rewarded])


@pytest.mark.parametrize("replan_every", [1, 2, 3])
@pytest.mark.parametrize("min_score", [None, 1.5])
def test_an_agent_whose_episode_is_over_begins_anew(replan_every, min_score):
    """Cell 3 of a corridor is an end that pays 2; plans are stored episode by episode, as counted by hand."""
    next_state = torch.tensor([[0, 1], [0, 2], [1, 3], [3, 3]])
    starts, ended = torch.tensor([0.3, 0.5, 0.2, 0.0]), torch.tensor([False, False, False, True])
    reward = torch.tensor([[-0.5, 0.25], [-0.25, 0.5], [0.125, 2.0], [0.0, 0.0]])
    world, prior = EpisodicWorld(next_state, reward[None], None, starts, ended), MarkovPrior(2, 0, num_contexts=4)
    state = torch.tensor([2, 1, 0, 3, 1])
    how = {"replan_every": replan_every, "learn_every": 12, "plan_length": 6, "retention": 1.0, "min_score": min_score}
    planner = SamplingPlanner(UniformPrior(2), 4, 3)
    one, begun, due = Agent(world, planner, prior, state, generator=seeded(0), **how), [], []
    reset = world.reset
    world.reset = lambda number, generator=None: begun.append(reset(number, generator)) or begun[-1]
    done = one.run(6)
    new = iter(torch.cat(begun).tolist())
    now, stored = (
        state.tolist(),
        [[([], [], [])] for _ in state],
    )
    for t in range(6):
        for b in range(5):
            if t % replan_every == 0 and now[b] == 3:
                now[b] = next(new)
                stored[b].append(([], [], []))
            action = int(done.actions[b, t])
            if now[b] != 3:
                for column, value in zip(stored[b][-1], (now[b], action, float(reward[now[b], action])), strict=True):
                    column.append(value)
            now[b] = int(next_state[now[b], action])
            assert int(done.states[b, t]) == now[b]
    assert next(new, None) is None
    due = [part for parts in stored for part in parts if part[1] and (min_score is None or sum(part[2]) > min_score)]
    plans = one.replay.plans
    found = [
        (plans.context[n, :length].tolist(), plans.actions[n, :length].tolist())
        for n, length in enumerate(plans.lengths.tolist())
    ]
    assert found == [(context, actions) for context, actions, _ in due]
    assert len(found) > (2 if min_score else 5)


def of_kind(kind):
    if kind == "gru":
        return agent(GRUPrior(4, hidden_size=8), training=TRAINING)
    if kind == "context":
        return agent(MarkovPrior(4, 1, num_contexts=36), min_score=0.0)
    prior = MarkovPrior(4, 2)
    return agent(prior, planner=sampler(prior, any_prefix=True), replan_every=1) if kind == "prefixes" else agent(prior)


@cache
def without_a_pause(kind):
    """An agent after forty steps, and what it did: the same for every moment of a pause."""
    through = of_kind(kind)
    return through, through.run(40)


@pytest.mark.parametrize(
    ("kind", "at"),
    [*((kind, at) for kind in ("no context", "context", "prefixes") for at in (8, 12, 14)), ("gru", 12), ("gru", 14)],
)
def test_a_pause_changes_nothing(kind, at, tmp_path):
    through, whole = without_a_pause(kind)
    first = of_kind(kind)
    before = first.run(at)
    save_agent(first, tmp_path / "saved")
    first.run(4)
    save_agent(first, tmp_path / "other")
    again = restore_agent(of_kind(kind), tmp_path / "saved")
    assert again.time == at
    after = again.run(40 - at)
    for name in ("actions", "rewards", "states"):
        assert torch.equal(torch.cat([getattr(before, name), getattr(after, name)], 1), getattr(whole, name))
    assert torch.equal(again.generator.get_state(), through.generator.get_state())
    assert len(again.replay) == len(through.replay)


def test_what_a_prior_has_learned_beside_its_weights_is_restored(tmp_path):
    first = MarkovPrior(4, 1, num_contexts=36)
    first.context_per = "plan"
    one = agent(first, retention=1.0)
    one.run(12)
    save_agent(one, tmp_path)
    again = restore_agent(agent(MarkovPrior(4, 1, num_contexts=36), retention=1.0), tmp_path)
    assert again.prior.learned == first.learned
    assert torch.equal(again.run(12).actions, one.run(12).actions)
    assert again.replay.plans.context.shape == (20, 6)


def test_a_folder_holds_one_checkpoint(tmp_path):
    one = agent()
    for _ in range(3):
        one.run(6)
        save_agent(one, tmp_path)
        save_agent(one, tmp_path)  # again at the same time
    assert [re.sub("-.*", "", path.name) for path in sorted(tmp_path.iterdir())] == ["agent", "agent.json", "prior"]


def test_what_others_put_there_stays(tmp_path):
    save(MarkovPrior(4, 1), tmp_path / "prior-mine")
    (tmp_path / "agent-notes.safetensors").write_text("mine")
    (tmp_path / "prior-notes.txt").write_text("mine")
    one = agent()
    for _ in range(2):
        one.run(12)
        save_agent(one, tmp_path)
    assert restore_agent(agent(), tmp_path).time == 24
    assert len(list(tmp_path.iterdir())) == 6
    load(tmp_path / "prior-mine")


def test_another_run_that_is_cut_off_leaves_the_last(tmp_path, monkeypatch):
    """Two agents at the same time of their runs, the second of which is not saved completely."""
    one, other = agent(seed=1), agent(seed=2)
    for some in (one, other):
        some.run(12)
    save_agent(one, tmp_path)
    write = checkpoints.write_whole
    for last in ("agent.json", "safetensors"):

        def cut_off(path, content, last=last):
            if last in path.name:
                raise KeyboardInterrupt
            write(path, content)

        with monkeypatch.context() as patched:
            patched.setattr(checkpoints, "write_whole", cut_off)
            with pytest.raises(KeyboardInterrupt):
                save_agent(other, tmp_path)
        again = restore_agent(agent(), tmp_path)
        assert torch.equal(again.state, one.state)
        assert torch.equal(again.prior.log_prob(every_plan(4, 3)), one.prior.log_prob(every_plan(4, 3)))


def test_damaged_checkpoints(tmp_path):
    one = agent()
    one.run(6)
    save_agent(one, tmp_path)
    with pytest.raises(FileNotFoundError):
        restore_agent(agent(), tmp_path / "nowhere")
    for other, word in (
        (agent(replan_every=1), "replan_every"),
        (agent(MarkovPrior(4, 1)), "config"),
        (agent(number=3), "agents"),
        (agent(retention=0.5), "retention"),
        (agent(warm_start=False), "warm_start"),
        (agent(num_rollouts=2), "num_rollouts"),
        (agent(learn_every=24), "learn_every"),
        (agent(plan_length=2), "plan_length"),
        (agent(min_score=0.0), "min_score"),
        (agent(planner=ExhaustivePlanner(3)), "planner"),
        (agent(UniformPrior(4)), "prior"),
    ):
        with refuses(word):
            restore_agent(other, tmp_path)
    path = tmp_path / "agent.json"
    text = json.loads(path.read_text())
    for content, word in (
        ("{", "not JSON"),
        ("[]", "not a checkpoint"),
        (json.dumps(text | {"version": 9}), "not a checkpoint"),
        (json.dumps({k: v for k, v in text.items() if k != "weights"}), "weights"),
        (json.dumps(text | {"agent": []}), "agent"),
        (json.dumps(text | {"prior": 3}), "prior"),
        (json.dumps(text | {"time": -5}), "time"),
        (json.dumps(text | {"recent": [1, "x"]}), "recent"),
        (json.dumps(text | {"recent": [1] * 9}), "recent"),
        (json.dumps(text | {"sha256": "0"}), "truncated"),
    ):
        path.write_text(content)
        with refuses(word):
            restore_agent(agent(), tmp_path)
    path.write_text(json.dumps(text))
    weights = tmp_path / text["weights"]
    weights.write_bytes(weights.read_bytes()[:-10])
    with refuses("truncated"):
        restore_agent(agent(), tmp_path)


@pytest.mark.parametrize(
    ("given", "word"),
    [
        ({"replan_every": 0}, "replan_every"),
        ({"plan_length": 5}, "`plan_length` must be a multiple of replan_every = 2"),
        ({"learn_every": 8}, "`learn_every` must be a multiple of plan_length = 6"),
        ({"num_rollouts": 0}, "num_rollouts"),
        ({"learn_every": "12"}, "learn_every"),
        ({"training": {"max_steps": 5}}, "max_steps"),
        ({"min_score": float("nan")}, "`min_score` must be a number, got nan"),
        ({"prior": MarkovPrior(3, 1)}, "must have 4 actions, as the world, got 3"),
    ],
)
def test_bad_agents(given, word):
    with refuses(word):
        agent(**given)


def test_a_planner_of_an_expert_that_the_prior_would_replace_is_refused():
    plans = Plans(torch.randint(4, (30, 6), generator=seeded(0)), 4)
    prior = CombinedPrior(4, effort="fast").fit(plans)
    assert prior.given is None
    with refuses("`planner` must"):
        agent(prior, planner=sampler(prior.alternatives[0]))
    agent(prior, planner=sampler(MarkovPrior(4, 1)), learn_every=None).run(6)


@pytest.mark.parametrize("pause", [6, 18])
def test_a_planner_of_a_given_expert_learns_along_also_after_a_pause(pause, tmp_path):
    def one():
        chain = MarkovPrior(4, 1)
        prior = CombinedPrior(4, experts=[UniformPrior(4), chain, MarkovPrior(4, 2), GRUPrior(4, 8)])
        return agent(prior, planner=sampler(chain), training={"max_steps": 2})

    whole, first = one(), one()
    done = whole.run(30)
    first.run(pause)
    again = restore_agent(one(), save_agent(first, tmp_path))
    rest = again.run(30 - pause)
    assert rest.actions.equal(done.actions[:, pause:])
    assert again.generator.get_state().equal(whole.generator.get_state())
    plans = torch.tensor([[0, 1, 1, 2, 3], [3, 3, 0, 0, 2]])
    assert again.planner.prior.log_prob(plans).equal(whole.planner.prior.log_prob(plans))
    assert not again.planner.prior.log_prob(plans).allclose(UniformPrior(4).log_prob(plans))


@pytest.mark.parametrize("inside", [lambda gru: gru, lambda gru: MixturePrior(4, [MarkovPrior(4, 1), gru])])
def test_a_network_goes_on_from_an_older_checkpoint(inside, tmp_path):
    """Of before its first fit: it had the sizes that `fit` would change, and no seed."""
    save_agent(agent(inside(GRUPrior(4))), tmp_path)
    path = tmp_path / "agent.json"
    text = json.loads(path.read_text())
    config = text["agent"]["config"]
    config = config["experts"][1]["config"] if "experts" in config else config
    config |= {"hidden_size": 64, "num_layers": 1, "lags": 16, "dropout": 0.0}
    del config["seed"]
    path.write_text(json.dumps(text))
    restore_agent(agent(inside(GRUPrior(4))), tmp_path).run(2)
    with refuses("config"):
        restore_agent(agent(inside(GRUPrior(4, hidden_size=8))), tmp_path)


def test_bad_runs():
    with refuses("`num_steps` must be a multiple of replan_every = 2"):
        agent().run(5)
    with refuses("num_steps"):
        agent().run(0)
    prior = MarkovPrior(4, 1)
    with refuses("fewer"):
        agent(prior, planner=sampler(prior, length=1)).run(4)
    with refuses("state"):
        Agent(foraging(), sampler(prior), prior, torch.zeros(3, dtype=torch.long))


def test_without_states_it_is_one_agent():
    world, prior = foraging(), MarkovPrior(4, 1)
    one = Agent(world, sampler(prior), prior, generator=seeded(0))
    assert one.run(3).actions.shape == (1, 3)
