"""Plans of vectors in files, Minari datasets and trajectories: there and back, and what is refused."""

import warnings

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from neuroprior.control import read_vector_plans, vector_plans_from_trajectories, write_vector_plans
from neuroprior.control.vector_plans import VectorPlans
from neuroprior.plans import from_trajectories, read_plans

LOW, HIGH = [-1.0, 0.0], [1.0, 2.0]
FIELDS = ("actions", "action_low", "action_high", "lengths", "context", "group")


def same(first, second):
    for key in FIELDS:
        one, two = getattr(first, key), getattr(second, key)
        assert (one is None and two is None) or one.equal(two), key
    assert first.action_names == second.action_names


def test_npz_there_and_back(tmp_path):
    actions = torch.rand(3, 4, 2, generator=torch.Generator().manual_seed(0))
    plain = VectorPlans(actions, LOW, HIGH)
    full = VectorPlans(
        actions,
        LOW,
        HIGH,
        lengths=torch.tensor([4, 0, 2]),
        context=torch.rand(3, 4, 5, generator=torch.Generator().manual_seed(1)),
        group=torch.tensor([7, 7, 8]),
        action_names=("hip", "knee"),
    )
    for plans in (plain, full):
        write_vector_plans(plans, tmp_path / "plans.npz")
        same(read_vector_plans(tmp_path / "plans.npz"), plans)


def test_trajectories_of_steps_and_of_arrays():
    steps = [(np.array([0.1, 0.2, 0.3]), np.array([0.5, 1.5]), 0.0, False, False, {})] * 2
    arrays = {"actions": np.zeros((3, 2)), "observations": np.ones((4, 3))}
    plans = vector_plans_from_trajectories([steps, arrays], LOW, HIGH)
    assert plans.actions[0, :2].tolist() == [[0.5, 1.5]] * 2
    assert plans.lengths.tolist() == [2, 3]
    torch.testing.assert_close(plans.context[0, 1], torch.tensor([0.1, 0.2, 0.3]))
    assert plans.context.shape == (2, 3, 3)
    assert vector_plans_from_trajectories([steps], LOW, HIGH, observations=None).context is None


@pytest.mark.parametrize("bounded", [True, False])
def test_minari_with_a_box_of_actions(bounded, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    from gymnasium.spaces import Box
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    random = np.random.default_rng(0)
    buffers = [
        EpisodeBuffer(
            observations=list(random.random((length + 1, 3), np.float32)),
            actions=list(random.random((length, 2), np.float32)),
            rewards=[0.0] * length,
            terminations=[False] * (length - 1) + [True],
            truncations=[False] * length,
        )
        for length in (4, 2)
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of missing authors, code and environment
        minari.create_dataset_from_buffers(
            "arm/random-v0",
            buffers,
            action_space=Box(np.array(LOW, np.float32), np.array(HIGH if bounded else [np.inf] * 2, np.float32)),
            observation_space=Box(-1, 1, (3,), np.float32),
        )
    if not bounded:
        with pytest.raises(ValueError, match="arm/random-v0: actions must have finite bounds"):
            read_vector_plans("minari:arm/random-v0")
        return
    plans = read_vector_plans("minari:arm/random-v0")
    assert plans.lengths.tolist() == [4, 2]
    assert plans.action_low.tolist() == LOW
    assert np.array_equal(plans.actions[1, :2], np.array(buffers[1].actions))
    assert np.array_equal(plans.context[0], np.array(buffers[0].observations)[:4])
    with pytest.raises(ValueError, match="read_vector_plans"):
        read_plans("minari:arm/random-v0")
    with pytest.raises(FileNotFoundError, match="arm/none-v0"):
        read_vector_plans("minari:arm/none-v0")


def test_arrays_of_other_names_are_warned_of(tmp_path):
    arrays = {"actions": np.ones((2, 3, 2)), "action_low": LOW, "action_high": HIGH}
    np.savez(tmp_path / "a.npz", **arrays, length=[3, 2], observations=np.zeros((2, 3, 1)))
    with pytest.warns(UserWarning, match="not used: length, observations"):
        plans = read_vector_plans(tmp_path / "a.npz")
    assert plans.lengths is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([{"actions": np.ones((3, 2))}], [-1.0], HIGH), r"`action_low` and `action_high` must have .*\[1\] and \[2\]"),
        (([{"actions": np.ones((3, 2))}], None, None), "action_low"),
        (({"actions": np.ones((3, 2))}, LOW, HIGH), "put it in a list"),
        (([], LOW, HIGH), "`trajectories` must have at least one"),
    ],
)
def test_what_is_wrong_with_trajectories_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        vector_plans_from_trajectories(*arguments)


def test_readers_name_one_another(tmp_path):
    write_vector_plans(VectorPlans(torch.zeros(1, 2, 2), LOW, HIGH), tmp_path / "vectors.npz")
    with pytest.raises(ValueError, match="read_vector_plans"):
        read_plans(tmp_path / "vectors.npz")
    np.savez(tmp_path / "numbers.npz", actions=np.zeros((2, 3), int), action_low=LOW, action_high=HIGH)
    with pytest.raises(ValueError, match="read_plans"):
        read_vector_plans(tmp_path / "numbers.npz")
    with pytest.raises(ValueError, match="vector_plans_from_trajectories"):
        from_trajectories([{"actions": np.zeros((3, 2))}], 4)
    with pytest.raises(ValueError, match=r"trajectory 0: .* from_trajectories"):
        vector_plans_from_trajectories([{"actions": [1, 2]}], LOW, HIGH)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"action_low": None}, "`action_low` is missing"),
        ({"actions": np.full((2, 3, 2), np.nan)}, "`actions` must be between the bounds"),
        ({"actions": np.full((2, 3, 2), "x")}, "`actions` must be numbers"),
        ({"actions": np.zeros((2, 3, 0)), "action_low": [], "action_high": []}, r"must have shape \[D\]"),
        ({"lengths": np.array([1, 9])}, "lengths"),
        ({"action_high": np.array([1.0])}, r"`action_high` must have shape \[2\]"),
        ({"action_names": np.array(["hip"])}, "`action_names` must be a list of 2 names"),
    ],
)
def test_wrong_files(tmp_path, change, message):
    arrays = {"actions": np.zeros((2, 3, 2)), "action_low": LOW, "action_high": HIGH} | change
    np.savez(tmp_path / "plans.npz", **{key: array for key, array in arrays.items() if array is not None})
    with pytest.raises(ValueError, match=f"plans.npz: .*{message}"):
        read_vector_plans(tmp_path / "plans.npz")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.integers(0, 2000), byte=st.integers(0, 255))
def test_damaged_files_are_refused_in_one_line_or_read(tmp_path, cut, byte):
    place = tmp_path / "plans.npz"
    write_vector_plans(VectorPlans(torch.zeros(2, 3, 2), LOW, HIGH, group=torch.tensor([0, 1])), place)
    content = bytearray(place.read_bytes())
    content[cut % len(content)] = byte
    place.write_bytes(content)
    try:
        assert isinstance(read_vector_plans(place), VectorPlans)
    except ValueError as error:
        assert "plans.npz" in str(error)  # noqa: PT017
        assert "\n" not in str(error)  # noqa: PT017
