"""What is observed of MiniGrid in `eval compare`, against what its table of transitions says can be done there."""

import torch

from eval.worlds.minigrid import KINDS, MOVES, NEAR, SIDE, layouts


def test_what_is_observed_is_what_can_be_done():
    """An agent that can go forward observes a free square, one that can open a door a closed one, and so on."""
    world = layouts("MiniGrid-DoorKey-5x5-v0", range(2))
    assert world.num_layouts == 2
    assert world.features.shape == (world.num_states, SIDE * SIDE * KINDS)
    going_on = ~world.ended
    before, left, _, carried = world.features[:, list(NEAR[0])].view(-1, 4, KINDS).bool().unbind(1)
    free, shut, thing, goal = before.unbind(1)
    state = torch.arange(world.num_states)
    after = {name: world.next_state[:, action] for action, name in enumerate(MOVES)}
    changes = {name: to != state for name, to in after.items()}
    assert torch.equal(changes["forward"][going_on], free[going_on])
    takes = thing & ~carried[:, 2]
    assert torch.equal(changes["pickup"][going_on], takes[going_on])
    assert int(takes.sum()) > 0
    assert bool(changes["toggle"][shut & carried[:, 2] & going_on].all())
    assert torch.equal(world.ended[after["forward"]][going_on], goal[going_on])
    # Who turns left has before it what was on the left.
    turned = world.features[after["left"]][:, list(NEAR[0])].view(-1, 4, KINDS).bool()
    assert torch.equal(turned[going_on, 0], left[going_on])
    assert torch.equal(turned[going_on, 2], before[going_on])
    assert set(NEAR[0]) < set(NEAR[1])
