"""Files that hold no plans: one line, which names the file and the line or the array."""

import io
import zipfile

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import Plans, fit
from neuroprior.behaviour import read
from neuroprior.control import VectorPlans, vector_plans_from_trajectories
from neuroprior.plans import from_trajectories, read_plans, write_plans
from tests.support.sources import refuses

ONE = Plans(torch.tensor([[0, 1]]), 2)


def refused(tmp_path, name, content, *words, **options):
    """Reading `content` must raise one line that says the words; "line N" is one of them where a line is wrong."""
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=r"\S") as caught:
        read_plans(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    for word in (str(path), *words):
        assert word in message, message


OK = '{"actions": [0, 1]}'


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([OK, '{"actions": [0, 1]'], ["line 2", "not JSON"]),
        ([OK, "", OK + OK], ["line 3", "one object a line"]),
        ([OK, "[0, 1]"], ["line 2", "is no plan"]),
        ([OK, '{"actions": [0], "actions": [1]}'], ["line 2", "the key 'actions' is given twice"]),
        ([OK, '{"action": [0]}'], ["line 2", '"actions"', "nothing"]),
        (['{"actions": [0], "group": "\\ud83d"}'], ["a.jsonl", "group_names", "half of a surrogate pair"]),
        ([OK, '{"actions": 3}'], ["line 2", "a list is expected, not 3"]),
        ([OK, '{"actions": [0, true]}'], ["line 2", "action True"]),
        ([OK, '{"actions": [0, 1.0]}'], ["line 2", "action 1.0"]),
        ([OK, '{"actions": [NaN]}'], ["line 2", "NaN is not a finite number"]),
        ([OK, '{"actions": [0, -1]}'], ["line 2", "action -1", "0 or more"]),
        ([OK, '{"actions": [99999999999999999999]}'], ["line 2", "out of range"]),
        ([OK, '{"actions": ["up"]}'], ["line 2", "mixed"]),
        (['{"actions": ["up", 0]}'], ["line 1", "mixed"]),
        ([OK, '{"actions": [0], "group": 1}'], ["line 2", "got 1", "in none"]),
        (['{"actions": [0], "group": 1}', '{"actions": [0], "group": "m"}'], ["line 2", "got 'm'"]),
        (["[" * 100000], ["line 1"]),
        (["9" * 5000], ["line 1"]),
        (['{"num_actions": 2}', OK, '{"actions": [2]}'], ["line 3", "action 2 is out of range", "0 to 1"]),
        (['{"num_actions": 0}', OK], ["line 1", "num_actions"]),
        (['{"num_actions": 2, "action_names": ["a"]}', OK], ["line 1", "must be 2 names"]),
        (['{"action_names": ["a", "a"]}', OK], ["line 1", "got 'a' twice"]),
        (['{"action_names": "ab"}', OK], ["line 1", "a list of names"]),
        (['{"action_names": ["a"]}', '{"actions": ["b"]}'], ["line 2", "action 'b' is none of a"]),
        (['{"num_actions": 2, "end": "x"}', OK], ["line 1", "end"]),
        (['{"num_actions": 2, "end": 0}', OK], ["goes on after the end symbol"]),
        (['{"num_actions": 2, "group_names": ["m"]}', '{"actions": [0], "group": 1}'], ["line 2", "group 1"]),
        (['{"num_actions": 3}', '{"actions": ["a"]}'], ["1 names of 3 actions"]),
        (['{"num_actions": 2}'], ["no plan"]),
        (['{"name": "x"}'], ["line 1", '"actions"']),
        (['{"actions": []}'], ["num_actions must be given"]),
    ],
)
def test_bad_jsonl(tmp_path, lines, words):
    refused(tmp_path, "a.jsonl", "\n".join(lines), *words)


@pytest.mark.parametrize(
    ("contexts", "words"),
    [
        (["1", "[1, 2]"], ["line 2", "a list of numbers", "have an integer"]),
        (["1", "null"], ["line 2", "no context"]),
        (["[1, 2]", "[1, 2, 3]"], ["line 2", "3 entries for 2 actions", "decimal point"]),
        (["[1.0, 2]", "[1, 2, 3]"], ["line 2", "3 features", "has 2"]),
        (["[1, 2]", '["a", "b"]'], ["line 2", "a list of names"]),
        (['["a"]', '["a", "b"]'], ["line 1", "1 entries for 2 actions"]),
        (["[[1], [2]]", "[[1], [2, 3]]"], ["line 2", "2 features"]),
        (["[[1], [2]]", "[[1]]"], ["line 2", "1 entries for 2 actions"]),
        (["[[], []]"], ["line 1", "empty list"]),
        (["[1, true]"], ["line 1", "must be numbers here, got True"]),
        (["[1.0, NaN]"], ["line 1", "NaN"]),
        (["[1.0, 1e999]"], ["line 1", "too large"]),
        (["[1.0, 1e39]"], ["line 1", "too large"]),
        (["-1"], ["line 1", "context -1"]),
        (["[0, 1]", "[0, -1]"], ["line 2", "context -1"]),
        (["[]"], ["line 1", "0 entries for 2 actions"]),
        (["[]", "3"], ["line 2", "an integer", "an empty list"]),
        (['{"x": 1}'], ["line 1", "neither"]),
    ],
)
def test_bad_context_in_jsonl(tmp_path, contexts, words):
    refused(tmp_path, "a.jsonl", "\n".join(f'{{"actions": [0, 1], "context": {c}}}' for c in contexts), *words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("action_1,action_2\n0,1\n\n0,1,1\n", ["line 4", "3 cells", "header has 2"]),
        ("a1,a2\n0,1\n", ["line 2", "'0' is a number where others are names", "header"]),
        ("0,1\n0,-1\n", ["line 2", "action -1 is out of range"]),
        ("0,1\n0,0.5\n", ["line 2", "'0.5' is not a whole number"]),
        ("0,1\n0,up\n", ["line 2", "'up' is a name where others are numbers", "action_names"]),
        ("up,1\n", ["line 1", "'1' is a number where others are names"]),
        ("action_1,action_3\n0,1\n", ["line 1", "action_2 is missing"]),
        ("action_1,action_1\n0,1\n", ["line 1", "'action_1' is there twice"]),
        ("action_1,context,context_1\n0,1,2\n", ["line 1", "one of them"]),
        ("action_1,context\n0,1\n0,\n", ["line 3", "`context` must be a number or a name, got an empty cell"]),
        ("action_1,context\n0,1\n0,x\n", ["line 3", "context 'x' is a name"]),
        ("action_1,context\n0,1\n0,1.0\n", ["line 3", "context_1"]),
        ("action_1,context\n0,-1\n", ["line 2", "context -1"]),
        ("action_1,context_1\n0,1\n0,nan\n", ["line 3", "'nan' is not a finite number"]),
        ("action_1,context_1\n0,1e39\n", ["line 2", "'1e39' is not a finite number"]),
        ("action_1,group\n0,1\n0,\n", ["line 3", "`group` must be a number or a name, got an empty cell"]),
        ('action_1,note\n1,"a\nb"\nx,c\n', ["line 4", "'x' is a name"]),
        ("plan,action\n1,0\n", ["line 1", "'plan'", "neuroprior.behaviour.read"]),
        ("session,behaviour,t\n1,walk,0\n", ["line 1", "'session'", "neuroprior.behaviour.read"]),
        ("Zeit;Behavior\n1;a\n", ["line 1", "'behavior'", "neuroprior.behaviour.read"]),
        ("action_1,action_2,action_3\n0,1,2\n0,,2\n", ["line 3", "an action is missing", "neuroprior.behaviour.read"]),
        ("action_1,action_2\n,1\n", ["line 2", "an action is missing"]),
        ("a,b\na,b\na,NA\n", ["line 3", "an action is missing"]),
        ("# made by x\n0\n1\n", ["line 1", "begins with #"]),
        ("#action\na\n", ["line 1", "begins with #"]),
        ("action_1\n", ["no plan below"]),
        ("\n\n", ["no rows"]),
        ('0,"1\n', ["line 1", "not CSV"]),
        ('action_1\n""\n', ["num_actions must be given"]),
    ],
)
def test_bad_csv(tmp_path, text, words):
    refused(tmp_path, "a.csv", text, *words)


def test_given_actions(tmp_path):
    refused(tmp_path, "a.csv", "0,1\n0,2\n", "line 2", "action 2", "0 to 1", num_actions=2)
    refused(tmp_path, "a.csv", "a,b\na,c\n", "line 2", "'c' is one more than the 2", num_actions=2)
    refused(tmp_path, "a.csv", "a,b\na,c\n", "line 2", "'c' is none of a, b", action_names=["a", "b"])
    refused(tmp_path, "a.csv", "0,1\n0,2\n", "line 2", "action 2", action_names=["a", "b"])
    refused(tmp_path, "a.jsonl", f'{OK}\n{{"actions": [2]}}', "line 2", "action 2", num_actions=2)
    refused(tmp_path, "a.jsonl", '{"actions": ["c"]}', "line 1", "'c' is none of a, b", action_names=["a", "b"])
    for options in ({"num_actions": 0}, {"num_actions": True}, {"num_actions": 2.0}):
        with refuses("num_actions"):
            read_plans(tmp_path / "a.csv", **options)
    for names in ("ab", [], ["a", "a"], [1, 2]):
        with refuses("action_names"):
            read_plans(tmp_path / "a.csv", action_names=names)
    with refuses("action_names", "3 names"):
        read_plans(tmp_path / "a.csv", num_actions=3, action_names=["a", "b"])


def test_the_line_of_a_later_block(tmp_path):
    rows = ["0,1"] * 5000
    refused(tmp_path, "a.csv", "\n".join([*rows, "0,7"]), "line 5001", num_actions=2)
    refused(tmp_path, "a.csv", "\n".join([*rows, "x,1"]), "line 5001")
    refused(tmp_path, "a.csv", "\n".join([*rows, "1"]), "line 5001")
    refused(tmp_path, "a.jsonl", "\n".join([OK] * 5000 + ['{"actions": [7]}']), "line 5001", num_actions=2)


@pytest.mark.parametrize("suffix", [".csv", ".jsonl", ".npz", ".tsv"])
def test_what_is_no_such_file(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    with refuses(str(path), error=FileNotFoundError):
        read_plans(path)
    refused(tmp_path, path.name, "", "an empty file")
    path.unlink()
    path.mkdir()
    with refuses(str(path), "a directory"):
        read_plans(path)
    with refuses(str(path), "a directory"):
        write_plans(ONE, path)
    with refuses(".csv, .tsv, .jsonl, .npz", "'.xlsx'"):
        read_plans(tmp_path / "a.xlsx")
    with refuses(".csv, .tsv, .jsonl, .npz", "no suffix"):
        write_plans(ONE, tmp_path / "a")


@pytest.mark.parametrize("name", ["a.csv", "a.jsonl"])
def test_other_encodings(tmp_path, name):
    refused(tmp_path, name, "0,1\n0,grün\n".encode("latin-1"), "line 2", "byte 5", "UTF-8")
    refused(tmp_path, name, "0,1\n0,2\n".encode("utf-16"), "line 1", "UTF-8")


def npz(**arrays):
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


GOOD = npz(actions=np.zeros((20, 3), np.uint8), num_actions=2)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"0,1", ["not a .npz file"]),
        (GOOD[:-30], ["not a .npz file"]),
        (npz(plans=[[1]]), ["no array 'actions'; it has plans"]),
        (npz(actions=np.array([[1, None]], object)), ["actions", "Python objects"]),
        (npz(actions=[["a"]]), ["actions", "numbers"]),
        (npz(actions=[[1.0]]), ["actions", "integers"]),
        (npz(actions=[1, 2]), ["actions", "[N, L]"]),
        (npz(actions=[[0, 1], [0, 2]], num_actions=2), ["actions[1, 1]: 2 is out of range"]),
        (npz(actions=[[0, -1]]), ["actions[0, 1]: -1"]),
        (npz(actions=[[0, 1]], num_actions=[2, 2]), ["num_actions", "one integer"]),
        (npz(actions=[[0, 1]], lengths=[3]), ["lengths[0]: 3"]),
        (npz(actions=[[0, 1]], lengths=[0]), ["num_actions must be given"]),
        (npz(actions=[[0, 1]], context=[[1.0, np.nan]]), ["context[0, 1]: nan"]),
        (npz(actions=[[0, 1]], action_names=["a"]), ["actions[0, 1]"]),
        (npz(actions=[[0, 1]], action_names=[["a", "b"]]), ["action_names", "texts"]),
        (npz(actions=[[0, 1]], lengths=[2], end=0), ["goes on after the end"]),
    ],
)
def test_bad_npz(tmp_path, content, words):
    refused(tmp_path, "a.npz", content, *words)


def test_an_array_alone_is_no_npz(tmp_path):
    file = io.BytesIO()
    np.save(file, np.zeros((2, 2), int))
    refused(tmp_path, "a.npz", file.getvalue(), "not a .npz file")
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        archive.writestr("actions.npy", b"no array")
    with refuses(str(tmp_path / "b.npz"), "actions"):
        read_plans(tmp_path / "b.npz")


def test_one_long_plan_among_many_short_ones(tmp_path):
    """Little data do not become much padding; data of one length may be as large, and few bytes are any data's."""
    lines = [f'{{"actions": {[0] * 2**16}}}'] + ['{"actions":[0, 1]}'] * 2**13
    words = "8,193 plans with 81,920 actions", f"{(2**13 + 1) * 2**16:,} bytes", "plan 1 of 65,536 actions; cut it into"
    refused(tmp_path, "a.jsonl", "\n".join(lines), *words)
    (tmp_path / "b.jsonl").write_text("\n".join(lines[:300]))
    assert read_plans(tmp_path / "b.jsonl").actions.shape == (300, 2**16)
    steps = [np.zeros((2**16 if i == 5 else 1, 300)) for i in range(6)]
    trajectories = [{"actions": np.zeros(len(some), int), "observations": some} for some in steps]
    with refuses("trajectories: 1,006 plans", "plan 6 of 65,536 actions"):
        from_trajectories(trajectories + [trajectories[0]] * 10**3, 1)


def test_arrays_that_unpack_to_far_more_than_the_file(tmp_path, monkeypatch):
    """The sizes that the archive declares are read before anything is unpacked."""
    monkeypatch.setattr("neuroprior._files.SMALL_BYTES", 2**20)
    zeros = np.zeros((2**10, 2**11), np.uint8)
    np.savez_compressed(tmp_path / "a.npz", actions=zeros[:, : 2**10 + 1])
    with refuses("a.npz: actions:", f"would unpack to {2**10 * (2**10 + 1) + 128:,}", "np.savez"):
        read_plans(tmp_path / "a.npz")
    np.savez_compressed(tmp_path / "b.npz", actions=zeros[:, : 2**9], group=np.arange(2**10))
    assert len(read_plans(tmp_path / "b.npz")) == 2**10
    np.savez(tmp_path / "c.npz", actions=zeros)
    assert read_plans(tmp_path / "c.npz").max_length == 2**11


LARGE = np.array([[0, 3], [10**9, 1]])


@pytest.mark.parametrize("suffix", [".jsonl", ".csv", ".npz", "array", ".events.csv"])
def test_a_number_that_is_no_action(suffix, tmp_path):
    """It is a time or a code, and would make as many actions, unless something says how many there are."""
    path = tmp_path / f"a{suffix}"
    if suffix == ".npz":
        np.savez(path, actions=LARGE)
    elif suffix == ".jsonl":
        path.write_text("\n".join(f'{{"actions": {row}}}' for row in LARGE.tolist()))
    elif suffix == ".events.csv":
        path.write_text("subject,time,behaviour\n" + "".join(f"m{i % 2},{i},{a}\n" for i, a in enumerate(LARGE.flat)))
    else:
        path.write_text("\n".join(",".join(map(str, row)) for row in LARGE.tolist()))
    calls = {
        "array": lambda **known: fit(torch.from_numpy(LARGE), "uniform"),
        ".events.csv": lambda **known: read(path).plans(**known),
    }
    call = calls.get(suffix, lambda **known: read_plans(path, **known))
    with refuses("below 65536 where nothing says how many there are, got 1000000000; give num_actions"):
        call()
    if suffix != "array":
        assert call(num_actions=10**9 + 1).actions.max() == 10**9


@pytest.mark.parametrize(
    ("plans", "name", "words"),
    [
        (ONE[:0], "a.npz", ["no plans"]),
        (Plans(torch.zeros(1, 0, dtype=torch.long), 2), "a.csv", ["none has an action"]),
        (ONE.with_end(), "a.csv", ["end symbol", "without_end"]),
        (Plans(torch.tensor([[0]]), 1, action_names=[" a"]), "a.csv", ["action_names", "' a'"]),
        (Plans(torch.tensor([[0]]), 1, context=torch.tensor([0]), context_names=["7"]), "a.csv", ["context_names"]),
        (Plans(torch.tensor([[0]]), 2, action_names=["1", "x"]), "a.csv", ["action_names", "'1'", "a number"]),
        (Plans(torch.tensor([[0]]), 2, action_names=["x", "NA"]), "a.csv", ["action_names", "'NA'", "as missing"]),
        (Plans(torch.tensor([[0]]), 1, context=torch.zeros(1, 0)), "a.csv", ["no features"]),
        (Plans(ONE.actions, 2, context=torch.tensor([[0, 1]])), "a.csv", ["changes within plans", ".jsonl or .npz"]),
        (Plans(torch.tensor([[0]]), 1, context=torch.tensor([[1e300]], dtype=torch.float64)), "a.jsonl", ["too large"]),
    ],
)
def test_what_cannot_be_written(tmp_path, plans, name, words):
    with refuses(str(tmp_path) if "names" not in words[0] and "twice" not in words[0] else words[0], *words):
        write_plans(plans, tmp_path / name)
    assert not list(tmp_path.iterdir())


WORDS = """action_1 plan action context context_1 group , ; " 0 1 -1 1.5 nan x { } {"actions":[ {"num_actions":3} ]}
    ,"context": [ ] : "a" true null 1e999 "actions" é"""
PIECES = st.sampled_from([*WORDS.split(), "\n", "\r\n", "", " ", "\ufeff", "\x00"])


@settings(derandomize=True, deadline=None, max_examples=500)
@given(pieces=st.lists(PIECES, max_size=25), suffix=st.sampled_from([".csv", ".tsv", ".jsonl"]))
def test_any_text_is_plans_or_one_line(tmp_path_factory, pieces, suffix):
    assert_plans_or_one_line(tmp_path_factory.getbasetemp() / f"any{suffix}", "".join(pieces).encode())


@settings(derandomize=True, deadline=None, max_examples=300)
@given(data=st.data(), suffix=st.sampled_from([".csv", ".jsonl", ".npz"]))
def test_damaged_files_are_plans_or_one_line(tmp_path_factory, data, suffix):
    texts = {
        ".npz": GOOD,
        ".csv": b"action_1,action_2,group\na,c,b\nc,,b\n",
        ".jsonl": b'{"actions": [0, 1], "context": [1, 2.5]}\n',
    }
    content = bytearray(texts[suffix])
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    assert_plans_or_one_line(tmp_path_factory.getbasetemp() / f"damaged{suffix}", bytes(content))


def assert_plans_or_one_line(path, content):
    path.write_bytes(content)
    message = f"{path}: read"
    try:
        read_plans(path)
    except ValueError as error:
        message = str(error)
    assert str(path) in message
    assert len(message.splitlines()) == 1


@pytest.mark.parametrize("name", ["a.jsonl", "a.csv"])
def test_features_that_files_hold_and_single_precision_does_not(name, tmp_path):
    """Of JSON lines, and of one plan a row."""
    rows = {"a.jsonl": '{{"actions": [0, 1], "context": [[{0}], [{1}]]}}\n', "a.csv": "0,1,{0},{1}\n"}
    head = {"a.jsonl": "", "a.csv": "action_1,action_2,context_1,context_2\n"}
    for begin in (1.7e9, 0.0):
        lines = "".join(rows[name].format(begin + 4.5 * i, begin + 4.5 * i + 2) for i in range(6))
        (tmp_path / name).write_text(head[name] + lines)
        if begin:
            with refuses(name, "context: feature 1 of", "single precision"):
                read_plans(tmp_path / name)
        else:
            assert read_plans(tmp_path / name).context.unique().tolist() == sorted(
                {4.5 * i + more for i in range(6) for more in (0, 2)}
            )


@pytest.mark.parametrize("kind", [np.float64, np.int64])
def test_observations_that_single_precision_does_not_hold(kind):
    """Times of episodes of unequal lengths, whose padding says nothing; not their last observations."""
    times = (1_700_000_000 + np.arange(21, dtype=kind))[:, None]
    for begin, refused in ((0, True), (1_700_000_000, False)):
        episodes = [{"actions": [0] * num, "observations": times[: num + 1] - begin} for num in (20, 5)]
        vectors = [{**one, "actions": np.zeros((len(one["actions"]), 1))} for one in episodes]
        for make in (
            lambda made=episodes: from_trajectories(made, 2),
            lambda made=vectors: vector_plans_from_trajectories(made, [-1.0], [1.0]),
        ):
            if refused:
                with refuses("trajectories", "context: feature 1 of 1", "single precision"):
                    make()
            else:
                assert make().context[1, :, 0].tolist() == [0, 1, 2, 3, 4] + 15 * [0]


def test_features_of_arrays_that_single_precision_does_not_hold(tmp_path):
    """Of `.npz` files; not what is beyond the end of a plan, nor without the offset."""
    times = 1.7e9 + torch.arange(10, dtype=torch.float64).view(2, 5, 1)
    times[1, 3:] = 0
    for begin in (0.0, 1.7e9):
        plans = Plans(torch.zeros(2, 5, dtype=torch.long), 2, torch.tensor([5, 3]), context=times - begin)
        write_plans(plans, tmp_path / "a.npz")
        if begin:
            assert read_plans(tmp_path / "a.npz").context.shape == (2, 5, 1)
        else:
            with refuses("a.npz", "context: feature 1 of 1", "single precision"):
                read_plans(tmp_path / "a.npz")


@pytest.mark.parametrize(
    "feature",
    [
        -0.323 + 1e-11 * np.sin(np.arange(1000)),  # a constant but for the noise of a solver
        5000.3 + (np.arange(1000) == 7),  # a single event, which float32 holds
        1e-46 * np.sin(np.arange(1000)),  # 0 in float32
        np.full(1000, 23.7),
    ],
)
def test_features_that_single_precision_holds_well_enough(feature):
    episodes = [{"actions": [0, 1] * 250, "observations": part[:, None]} for part in np.split(feature, 2)]
    assert from_trajectories(episodes, 2).context.shape == (2, 500, 1)


def test_features_of_vectors_that_single_precision_does_not_hold():
    context = 1.7e9 + torch.arange(10, dtype=torch.float64).view(2, 5, 1)
    with refuses("context", "feature 1 of 1", "single precision"):
        VectorPlans(torch.zeros(2, 5, 1), [-1.0], [1.0], context=context)
    context[1, 3:] = 0  # beyond the end of a plan
    with refuses("context", "feature 1 of 1", "single precision"):
        VectorPlans(torch.zeros(2, 5, 1), [-1.0], [1.0], torch.tensor([5, 3]), context)
