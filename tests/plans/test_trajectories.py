"""Trajectories of Gymnasium's environments and datasets of Minari: plans there and back, and what is no plan."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import Plans
from neuroprior.control import VectorPlans
from neuroprior.plans import from_trajectories, read_minari, to_trajectories, write_minari
from tests.support.sources import refuses

ACTIONS = torch.tensor([[0, 2, 1], [1, 0, 0]])
LENGTHS = torch.tensor([3, 1])


def steps(actions, observations):
    return [(observed, action, 0.5, False, False, {}) for observed, action in zip(observations, actions, strict=True)]


@pytest.mark.parametrize("as_what", ["steps", "dict", "object", "one more"])
@pytest.mark.parametrize("kind", ["index", "features", "picture"])
def test_trajectories_become_plans(as_what, kind):
    rng = np.random.default_rng(0)
    observed = {
        "index": [np.array([4, 0, 7]), np.array([1])],
        "features": [rng.random((3, 2)), rng.random((1, 2))],
        "picture": [rng.integers(9, size=(3, 2, 2)), rng.integers(9, size=(1, 2, 2))],
    }[kind]
    taken = [[0, 2, 1], np.array([1], np.int32)]
    if as_what == "steps":
        given_as = [steps(a, o) for a, o in zip(taken, observed, strict=True)]
    elif as_what == "one more":
        given_as = [
            {"actions": a, "observations": np.concatenate([o, o[:1]])} for a, o in zip(taken, observed, strict=True)
        ]
    else:
        given_as = [{"actions": a, "observations": o} for a, o in zip(taken, observed, strict=True)]
        given_as = [SimpleNamespace(**one) for one in given_as] if as_what == "object" else given_as
    plans = from_trajectories(iter(given_as), 3)
    assert (plans.actions.tolist(), plans.lengths.tolist()) == (ACTIONS.tolist(), [3, 1])
    for row, one in enumerate(observed):
        expected = torch.tensor(one)
        if kind == "index":
            assert torch.equal(plans.context[row, : len(one)], expected)
        else:
            assert plans.context.dtype == torch.float32
            assert torch.equal(plans.context[row, : len(one)], expected.flatten(1).float())
    assert from_trajectories(given_as, 3, observations=None).context is None


def same(one, other):
    assert (one.num_actions, one.end) == (other.num_actions, other.end)
    for key in ("actions", "lengths", "context", "group"):
        a, b = getattr(one, key), getattr(other, key)
        assert (a is None) == (b is None), key
        beyond = 0 if key != "context" or a is None else ~one.mask().view(*one.actions.shape, *[1] * (a.dim() - 2))
        a, b = (x if key != "context" or x is None else x.masked_fill(beyond, 0) for x in (a, b))
        assert a is None or torch.equal(a, b), key
    for key in ("action_names", "context_names", "group_names"):
        assert (getattr(one, key) and tuple(getattr(one, key))) == (getattr(other, key) and tuple(getattr(other, key)))


INDICES, FEATURES = torch.tensor([[1, 2, 0], [3, 0, 0]]), torch.tensor([[[0.5], [1], [2]], [[3], [0], [0]]])


@pytest.mark.parametrize("context", [None, INDICES, FEATURES], ids=["none", "index", "features"])
def test_there_and_back(context):
    plans = Plans(ACTIONS, 3, LENGTHS, context=context)
    trajectories = to_trajectories(plans)
    assert [trajectory["actions"].tolist() for trajectory in trajectories] == [[0, 2, 1], [1]]
    assert all(("observations" in trajectory) == (context is not None) for trajectory in trajectories)
    same(from_trajectories(trajectories, 3), plans)


@settings(derandomize=True, deadline=None)
@given(rows=st.lists(st.lists(st.integers(0, 4), max_size=5), min_size=1, max_size=5))
def test_any_actions_there_and_back(rows):
    plans = from_trajectories([{"actions": row} for row in rows], 5)
    assert [trajectory["actions"].tolist() for trajectory in to_trajectories(plans)] == rows


@pytest.mark.parametrize(
    ("trajectory", "words"),
    [
        (5, ["a list of steps"]),
        ([(1, 2)], ["step 0", "(observation, action,"]),
        ({"action": [0]}, ["no 'actions'", "action"]),
        ({"actions": [0.5, 1.0]}, ["float64", "discrete"]),
        ({"actions": np.zeros((3, 2), int)}, ["[3, 2]", "discrete"]),
        ({"actions": [True, False]}, ["bool", "discrete"]),
        ({"actions": [[0], [1, 2]]}, ["actions", "fixed shape"]),
        ({"actions": [0, 3]}, ["action 3 of step 1", "0 to 2"]),
        ({"actions": [0, -1]}, ["action -1 of step 1"]),
        ({"actions": [0], "observations": [1, 2, 3]}, ["3", "1 or 2"]),
        ({"actions": [0], "observations": {"a": [1]}}, ["Dict or Tuple", "flatten"]),
        ({"actions": [0], "observations": ([1], [2])}, ["Dict or Tuple"]),
        (steps([0], [{"a": 1}]), ["Dict or Tuple"]),
        (steps([0, 0], [(np.zeros(2), 1), (np.zeros(2), 1)]), ["fixed shape"]),
        (steps([0, 0], [[1.0], [1.0, 2.0]]), ["fixed shape"]),
        ({"actions": [0], "observations": ["light"]}, ["got <U5"]),
        ({"actions": [0], "observations": [-1]}, ["observations from 0", "got -1"]),
        ({"actions": [0, 0], "observations": [[1.0], [np.nan]]}, ["step 1", "not finite"]),
        ({"actions": [0], "observations": [[1.0, 2.0]]}, ["2 features, not integers"]),
        ({"actions": [0]}, ["no observations", "trajectory 0"]),
    ],
)
def test_what_is_no_trajectory(trajectory, words):
    with refuses("trajectory 1", *words):
        from_trajectories([{"actions": [0, 1], "observations": [0, 1]}, trajectory], 3)


def test_arguments():
    with refuses("got an empty list"):
        from_trajectories([], 3)
    with refuses("num_actions", "0"):
        from_trajectories([{"actions": [0]}], 0)
    with refuses("observations", "'all'"):
        from_trajectories([{"actions": [0]}], 2, observations="all")


@pytest.fixture
def minari(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    pytest.importorskip("h5py")
    return pytest.importorskip("minari")


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"context": INDICES, "context_names": ("a", "b", "c", "d")},
        {"context": FEATURES},
        {"context": torch.tensor([5, 2])},
        {"context": torch.tensor([[0.5, 2], [1, 1]])},
        {"group": torch.tensor([1, 0]), "group_names": ("m1", "m2")},
        {"end": 1},
    ],
    ids=["actions", "names", "features", "index per plan", "features per plan", "groups", "end"],
)
def test_minari_there_and_back(minari, more):
    plans = Plans(ACTIONS, 3, LENGTHS, ("up", "down", "stay"), **more)
    write_minari(plans, "mice/field-v0")
    same(read_minari("mice/field-v0"), plans)
    assert read_minari("mice/field-v0", observations=False).context is None
    dataset = minari.load_dataset("mice/field-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (2, 4)
    assert [len(episode.observations) for episode in dataset] == [4, 2]


def made_by_others(minari, name, actions, action_space, observations, observation_space):
    buffer = minari.data_collector.EpisodeBuffer(
        observations=observations,
        actions=actions,
        rewards=np.zeros(2),
        terminations=np.zeros(2, bool),
        truncations=np.zeros(2, bool),
    )
    minari.create_dataset_from_buffers(name, [buffer], action_space=action_space, observation_space=observation_space)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_minari_of_others(minari):
    from gymnasium import spaces

    discrete, box = spaces.Discrete(3, start=-1), spaces.Box(-1, 1, (2, 2))
    made_by_others(minari, "a-v0", np.array([1, -1]), discrete, np.array([5, 6, 7]), spaces.Discrete(9, start=5))
    plans = read_minari("a-v0")
    assert (plans.actions.tolist(), plans.num_actions, plans.context.tolist()) == ([[2, 0]], 3, [[0, 1]])
    made_by_others(minari, "b-v0", np.array([1, -1]), discrete, np.ones((3, 2, 2), np.float32), box)
    assert read_minari("b-v0").context.shape == (1, 2, 4)
    pair = spaces.Dict({"a": spaces.Discrete(2)})
    made_by_others(minari, "c-v0", np.array([1, -1]), discrete, {"a": np.array([0, 1, 0])}, pair)
    with refuses("c-v0", "Dict", "observations=False"):
        read_minari("c-v0")
    assert read_minari("c-v0", observations=False).actions.tolist() == [[2, 0]]
    made_by_others(minari, "d-v0", np.ones((2, 2, 2), np.float32), box, np.array([5, 6, 7]), spaces.Discrete(9))
    with refuses("d-v0", "Box", "discrete actions are expected"):
        read_minari("d-v0")


def test_minari_refuses(minari, tmp_path, monkeypatch):
    with refuses("none-v0", "minari download none-v0", error=FileNotFoundError):
        read_minari("none-v0")
    with refuses("a-v0", "without actions"):
        write_minari(Plans(ACTIONS, 3, torch.tensor([3, 0])), "a-v0")
    with refuses("a-v0", "no plans"):
        write_minari(Plans(ACTIONS, 3)[:0], "a-v0")
    with refuses("`plans` must be Plans", "got VectorPlans"):
        write_minari(VectorPlans(torch.zeros(2, 3, 1), [-1.0], [1.0]), "a-v0")
    with refuses("no id"):
        write_minari(Plans(ACTIONS, 3), "no id")
    assert not (tmp_path / "no id").exists()
    write_minari(Plans(ACTIONS, 3), "a-v0")
    with refuses("a-v0", "already exists"):
        write_minari(Plans(ACTIONS, 3), "a-v0")
    assert len(read_minari("a-v0")) == 2
    (tmp_path / "a-v0" / "data" / "main_data.hdf5").write_bytes(b"cut off")
    with refuses("a-v0"):
        read_minari("a-v0")
    monkeypatch.setattr("minari.create_dataset_from_buffers", lambda name, *_, **__: (tmp_path / name).mkdir() or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_minari(Plans(ACTIONS, 3), "half-v0")
    assert not (tmp_path / "half-v0").exists()


def test_without_minari(monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    for call in (lambda: read_minari("a-v0"), lambda: write_minari(Plans(ACTIONS, 3), "a-v0")):
        with refuses("pip install 'neuroprior[gym]'", error=ImportError):
            call()


def test_trajectories_of_imitation_are_read() -> None:
    one = SimpleNamespace(acts=np.array([0, 2]), obs=np.array([[0.5], [1.0], [9.0]]), infos=None, terminal=True)
    plans = from_trajectories([one], 3)
    assert plans.actions.tolist() == [[0, 2]]
    assert plans.context.tolist() == [[[0.5], [1.0]]]


def test_trajectories_of_imitation_are_made() -> None:
    plans = Plans(torch.tensor([[0, 1], [2, 0]]), 3, torch.tensor([2, 1]))
    with refuses("kind"):
        to_trajectories(plans, "imitations")
    with refuses("no context"):
        to_trajectories(plans, "imitation")
    types = pytest.importorskip("imitation.data.types", reason="imitation is not installed")
    plans = Plans(plans.actions, 3, plans.lengths, context=torch.arange(4).view(2, 2))
    first, second = to_trajectories(plans, "imitation")
    assert isinstance(first, types.Trajectory)
    assert (first.obs.tolist(), first.acts.tolist(), first.terminal) == ([0, 1, 1], [0, 1], True)
    assert (second.obs.tolist(), second.acts.tolist()) == ([2, 2], [2])
    back = from_trajectories([first, second], 3)
    assert torch.equal(back.actions, plans.actions)
    empty = Plans(plans.actions, 3, torch.tensor([2, 0]), context=plans.context)
    with refuses("plan 1 has no actions"):
        to_trajectories(empty, "imitation")
