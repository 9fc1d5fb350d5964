"""Files of plans: what is written comes back, and what others write is read as they mean it."""

import csv
import json

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import Plans
from neuroprior._files import quote_cell, unquote_cell
from neuroprior.behaviour import read
from neuroprior.behaviour.reporting import ReadOptions
from neuroprior.behaviour.reporting.document import write_frames
from neuroprior.plans import expand_context, read_plans, write_plans
from neuroprior.plans.columns import is_missing, number_in

NAMES = st.text(st.characters(codec="utf-8"), min_size=1, max_size=6)
CONTEXTS = ("none", "index", "name", "index per step", "name per step", "features", "features per step")
FLOATS = st.floats(width=32, allow_nan=False, allow_infinity=False)


def in_csv(name):
    plain = name == name.strip() and not set(name) & set("\r\n")
    return plain and number_in(name) is None and not is_missing(name)


@st.composite
def plans_of_all_kinds(draw, names=NAMES, contexts=CONTEXTS):
    """Plans of which one at least has an action, with any kind of context, names, groups and `end`."""
    lengths = draw(st.lists(st.integers(0, 5), min_size=1, max_size=6))
    lengths[0] = max(lengths[0], 1)
    num, longest, num_actions = len(lengths), max(lengths), draw(st.sampled_from([1, 3, 300]))

    def numbers(stop, *shape):
        size = int(np.prod(shape))
        return torch.tensor(
            draw(st.lists(st.integers(0, stop - 1), min_size=size, max_size=size)), dtype=torch.long
        ).reshape(shape)

    def some_names(count):
        return tuple(draw(st.lists(names, min_size=count, max_size=count, unique=True)))

    actions, kind = numbers(num_actions, num, longest), draw(st.sampled_from(contexts))
    there = torch.arange(longest) < torch.tensor(lengths)[:, None]
    context = None
    if kind.startswith("features"):
        shape = (num, longest, 2) if kind.endswith("step") else (num, 2)
        size = int(np.prod(shape))
        context = torch.tensor(draw(st.lists(FLOATS, min_size=size, max_size=size))).reshape(shape)
        context = context * there[..., None] if kind.endswith("step") else context
    elif kind != "none":
        context = numbers(4, num, longest) * there if kind.endswith("step") else numbers(4, num)
    group_names = some_names(3) if draw(st.booleans()) else None
    return Plans(
        actions,
        num_actions,
        None if min(lengths) == longest else torch.tensor(lengths),
        some_names(3) if num_actions == 3 and draw(st.booleans()) else None,
        context,
        numbers(3, num) if group_names or draw(st.booleans()) else None,
        some_names(4) if kind.startswith("name") else None,
        group_names,
    )


def called(numbers, names):
    return None if numbers is None else [names[i] if names else i for i in numbers.flatten().tolist()]


def assert_same(one, other, numbering=True):
    """The same plans; with `numbering` False, contexts and groups need have the same names only, not numbers."""
    assert (one.num_actions, one.end) == (other.num_actions, other.end)
    for key in ("actions", "lengths", "context", "group"):
        a, b = getattr(one, key), getattr(other, key)
        assert (a is None) == (b is None), key
        names = f"{key}_names"
        if a is None:
            continue
        assert a.shape == b.shape
        if numbering or (key != "group" and not getattr(one, names, None)):
            assert a.dtype == b.dtype
            assert torch.equal(a, b), key
        elif a.dim() == 2:  # names of contexts; what stands beyond a plan's end does not count
            for row, (x, y) in enumerate(zip(a, b, strict=True)):
                length = int(one.mask()[row].sum())
                assert called(x[:length], one.context_names) == called(y[:length], other.context_names)
        else:
            assert list(map(str, called(a, getattr(one, names)))) == list(map(str, called(b, getattr(other, names))))
    assert one.action_names == other.action_names
    if numbering:
        for what in ("context", "group"):
            assert getattr(one, f"{what}_names") == getattr(other, f"{what}_names")


@pytest.mark.parametrize("suffix", [".npz", ".jsonl"])
@settings(derandomize=True, deadline=None, max_examples=60)
@given(plans=plans_of_all_kinds(), closed=st.booleans())
def test_npz_and_jsonl_hold_everything(tmp_path_factory, suffix, plans, closed):
    path = tmp_path_factory.mktemp("files") / f"plans{suffix}"
    plans = plans.with_end(name="the end") if closed and "the end" not in (plans.action_names or ()) else plans
    write_plans(plans, path)
    assert_same(read_plans(path), plans)


@pytest.mark.parametrize("suffix", [".csv", ".tsv"])
@settings(derandomize=True, deadline=None, max_examples=60)
@given(plans=plans_of_all_kinds(names=NAMES.filter(in_csv), contexts=("none", "index", "name", "features")))
def test_csv_holds_actions_contexts_and_groups(tmp_path_factory, suffix, plans):
    path = tmp_path_factory.mktemp("files") / f"plans{suffix}"
    write_plans(plans, path)
    back = read_plans(path, num_actions=plans.num_actions, action_names=plans.action_names)
    assert_same(back, plans, numbering=False)


def test_csv_holds_plans_without_actions_beside_others(tmp_path):
    plans = Plans(torch.tensor([[0], [1], [0]]), 2, torch.tensor([0, 1, 0]))
    write_plans(plans, tmp_path / "a.csv")
    assert_same(read_plans(tmp_path / "a.csv"), plans)


@pytest.mark.parametrize(
    ("context", "columns"),
    [
        (torch.tensor([3, 1]), ["action_1", "action_2", "context"]),
        (torch.tensor([[3, 3], [1, 1]]), ["action_1", "action_2", "context"]),
        (torch.tensor([[0.5, 1], [2, 3]]), ["action_1", "action_2", "context_1", "context_2"]),
        (None, ["action_1", "action_2"]),
    ],
)
def test_the_columns_of_csv(tmp_path, context, columns):
    path = tmp_path / "a.csv"
    write_plans(Plans(torch.tensor([[0, 1], [1, 1]]), 2, context=context), path)
    assert path.read_text().splitlines()[0].split(",") == columns
    back = read_plans(path)
    assert back.actions.tolist() == [[0, 1], [1, 1]]
    assert context is None or torch.equal(back.context, expand_context(context, 2))


def read_text(tmp_path, name, text, **options):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_plans(path, **options)


def test_jsonl_by_hand(tmp_path):
    plans = read_text(
        tmp_path,
        "a.jsonl",
        '{"plan": 1, "actions": ["rear", "groom"], "context": ["light", "dark"], "group": "m2"}\n\n'
        '{"plan": 2, "actions": ["walk"], "context": ["dark"], "group": "m10"}\r\n',
    )
    assert plans.action_names == ("groom", "rear", "walk")
    assert plans.actions.tolist() == [[1, 0], [2, 0]]
    assert plans.lengths.tolist() == [2, 1]
    assert (plans.context.tolist(), plans.context_names) == ([[1, 0], [0, 0]], ("dark", "light"))
    assert (plans.group.tolist(), plans.group_names) == ([1, 0], ("m10", "m2"))


@pytest.mark.parametrize(
    ("contexts", "expected"),
    [
        (["4", "0"], torch.tensor([4, 0])),
        (["[4, 0]", "[1, 1]"], torch.tensor([[4, 0], [1, 1]])),
        (["[4, 0]", "[1, 1.0]"], torch.tensor([[4.0, 0], [1, 1]])),
        (["[-4, 0]", "[1, 1.0]"], torch.tensor([[-4.0, 0], [1, 1]])),
        (["[4, 0, 2]", "[1, 1e0, 3]"], torch.tensor([[4.0, 0, 2], [1, 1, 3]])),
        (["[[4], [0]]", "[[1], [2]]"], torch.tensor([[[4.0], [0]], [[1], [2]]])),
        (["null", "null"], None),
    ],
)
def test_jsonl_context_is_of_the_kind_of_the_whole_file(tmp_path, contexts, expected):
    lines = [f'{{"actions": [0, 1], "context": {context}}}' for context in contexts]
    back = read_text(tmp_path, "a.jsonl", "\n".join(lines)).context
    if expected is None:
        assert back is None
    else:
        assert torch.equal(back, expand_context(expected, 2))
        assert back.dtype == expected.dtype


def test_a_decimal_point_may_come_in_a_later_plan(tmp_path):
    lines = ['{"actions": [0, 1], "context": [1, 2]}'] * 20 + ['{"actions": [0, 1], "context": [1, 2.5]}'] * 20
    plans = read_text(tmp_path, "a.jsonl", "\n".join(lines))
    assert plans.context.tolist() == [[[1, 2]] * 2] * 20 + [[[1, 2.5]] * 2] * 20


@pytest.mark.parametrize(
    "text",
    [
        "action_1,action_2,action_3\n0,1,2\n1,,\n",
        "0,1,2\n1,,\n",
        "0;1;2\r\n1;;\r\n",
        "\ufeffaction_1\taction_2\taction_3\r\n0\t1\t2\r\n1\t\t\r\n",
        "Action_2,note,action_1,action_3\n1,x,0,2\n,y,1,\n",
        "0.0,1.0,2.0\n1.0,,\n",
        "0.000000e+00,1.000000e+00,2.000000e+00\n1e0, ,\n",
        '\ufeffnote;action_1;action_2;action_3\n"a;b\n c";0;1;2\n;1;;',
    ],
)
def test_csv_by_hand(tmp_path, text):
    plans = read_text(tmp_path, "a.csv", text)
    assert (plans.actions.tolist(), plans.lengths.tolist()) == ([[0, 1, 2], [1, 0, 0]], [3, 1])
    assert plans.num_actions == 3


def test_csv_of_numpy(tmp_path):
    actions = np.random.default_rng(0).integers(5, size=(3000, 4))
    for form in ("%d", "%.18e"):
        np.savetxt(tmp_path / "a.csv", actions, fmt=form, delimiter=",")
        assert read_plans(tmp_path / "a.csv").actions.tolist() == actions.tolist()


def test_csv_with_names(tmp_path):
    plans = read_text(
        tmp_path,
        "a.tsv",
        "Action_1\tNote\tAction_2\tContext\tGroup\nrear\t0.5\tgroom up\tlight\t12\nrear\t9\t\tdark\t12b\n",
        action_names=["rear", "walk", "groom up"],
    )
    assert (plans.actions.tolist(), plans.lengths.tolist(), plans.num_actions) == ([[0, 2], [0, 0]], [2, 1], 3)
    assert (plans.context.tolist(), plans.context_names) == ([[1, 1], [0, 0]], ("dark", "light"))
    assert (plans.group.tolist(), plans.group_names) == ([0, 1], ("12", "12b"))


def test_names_that_are_numbers_are_names_where_they_are_given(tmp_path):
    plans = read_text(tmp_path, "a.csv", "9,1.5\n1.5,up\n", action_names=["1.5", "9", "up"])
    assert plans.actions.tolist() == [[1, 0], [0, 2]]
    assert read_text(tmp_path, "a.csv", "1,0\n", action_names=["up", "down"]).actions.tolist() == [[1, 0]]
    plans = read_text(tmp_path, "a.jsonl", '{"actions": ["10", "9"]}')
    assert (plans.action_names, plans.actions.tolist()) == (("10", "9"), [[0, 1]])


@pytest.mark.parametrize("suffix", [".npz", ".jsonl"])
def test_given_names_number_the_actions_anew(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_plans(Plans(torch.tensor([[0, 1, 2], [1, 2, 0]]), 3, action_names=("a", "b", "end"), end=2), path)
    plans = read_plans(path, action_names=["end", "a", "c", "b"])
    assert (plans.actions.tolist(), plans.lengths.tolist()) == ([[1, 3, 0], [3, 0, 0]], [3, 2])
    assert (plans.end, plans.num_actions) == (0, 4)
    with pytest.raises(ValueError, match=f"{path}.*'a' is none of b, c"):
        read_plans(path, action_names=["b", "c", "end"])


def test_npz_needs_actions_only(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", actions=np.array([[0, 9, 9], [1, 2, 3]], ">i4"), lengths=[1, 3], other=1)
    with pytest.warns(UserWarning, match="arrays that are not used: other"):
        plans, more = read_plans(tmp_path / "a.npz"), read_plans(tmp_path / "a.npz", num_actions=7)
    assert (plans.actions.tolist(), plans.num_actions) == ([[0, 0, 0], [1, 2, 3]], 4)
    assert more.num_actions == 7


def test_an_old_file_is_replaced_or_stays(tmp_path):
    path = tmp_path / "a.jsonl"
    write_plans(Plans(torch.tensor([[0]]), 2), path)
    before = path.read_bytes()
    resource = pytest.importorskip("resource")  # not on Windows
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))  # in the middle of writing, as on a full disk
    try:
        with pytest.raises(OSError, match="too large"):
            write_plans(Plans(torch.ones(5000, 1, dtype=torch.long), 2), path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["a.csv", "a.jsonl"])
def test_what_belongs_to_plans_stays_with_them_in_long_files(name, tmp_path):
    """Files are written in blocks of 16,384 plans; each plan has its own length, context and group."""
    number = torch.arange(2**14 + 3)
    plans = Plans((number % 7)[:, None].expand(-1, 4), 7, 1 + number % 4, context=number, group=number)
    write_plans(plans, tmp_path / name)
    assert_same(read_plans(tmp_path / name), plans)


@pytest.mark.parametrize(("suffix", "delimiter"), [(".csv", ","), (".csv", ";"), (".tsv", "\t")])
@pytest.mark.parametrize("header", [False, True])
def test_a_row_may_be_longer_than_a_cell_can_be(suffix, delimiter, header, tmp_path):
    """Plans of 70,000 actions: for each other delimiter a line is a single cell, of more than `csv` takes."""
    actions = torch.arange(140_000).view(2, -1) % 3
    rows = [[f"action_{t}" for t in range(1, 70_001)]] if header else []
    rows += [list(map(str, row)) for row in actions.tolist()]
    (tmp_path / f"plans{suffix}").write_text("\n".join(map(delimiter.join, rows)) + "\n")
    assert read_plans(tmp_path / f"plans{suffix}").actions.equal(actions)


@pytest.mark.parametrize("name", ["A.CSV", "a.Tsv", "a.JSONL", "a.NPZ"])
def test_suffixes_may_be_in_capitals(name, tmp_path):
    some = Plans(torch.arange(15).view(5, 3) % 4, 4, torch.tensor([2, 1, 3, 3, 1]), group=torch.arange(5))
    write_plans(some, tmp_path / name)
    assert_same(read_plans(tmp_path / name, num_actions=4), some)
    write_plans(some, tmp_path / name.lower())
    assert (tmp_path / name).read_bytes() == (tmp_path / name.lower()).read_bytes()


def test_what_is_not_read_is_said(tmp_path):
    """A misspelt key would make plans of one animal independent ones."""
    write = {
        "plans.jsonl": lambda file, key: file.write_text(
            "".join(json.dumps({"plan": 1, "actions": [0, 1], key: 3}) + "\n" for _ in range(2))
        ),
        "plans.npz": lambda file, key: np.savez(file, actions=np.array([[0, 1], [0, 1]]), **{key: np.array([3, 3])}),
    }
    for name, save in write.items():
        save(tmp_path / name, "group")
        assert read_plans(tmp_path / name).group.tolist() == [3, 3]
        save(tmp_path / name, "grup")
        with pytest.warns(UserWarning, match=f"{name}: (keys|arrays) that are not used: grup$") as warned:
            assert read_plans(tmp_path / name).group is None
        assert [one.filename for one in warned] == [__file__]
        (note,) = ReadOptions().read(str(tmp_path / name)).notes
        assert note.endswith("that are not used: grup")


def test_groups_in_an_npz_file_may_be_names_without_spaces(tmp_path):
    actions, groups = np.array([[0, 1]] * 3), np.array(["b ", "a", "b"])
    np.savez(tmp_path / "plans.npz", actions=actions, group=groups, condition=groups)
    plans = ReadOptions().read(str(tmp_path / "plans.npz"))
    for number, names in ((plans.group, plans.group_names), (plans.condition, plans.condition_names)):
        assert [names[i] for i in number.tolist()] == ["b", "a", "b"]
    np.savez(tmp_path / "plans.npz", actions=actions, group=np.array(["a", "", "b"]))
    with pytest.raises(ValueError, match="group: an empty text"):
        read_plans(tmp_path / "plans.npz")


def test_plans_are_shown_in_short():
    plans = Plans(torch.zeros(300, 40, dtype=torch.long), 2, torch.full((300,), 7))
    assert repr(plans) == "Plans(actions [300, 40], num_actions 2, lengths [300])"


@pytest.mark.parametrize("name", ["a.jsonl", "a.npz"])
def test_as_many_features_of_a_plan_as_it_has_actions_are_noted(name, tmp_path):
    """They may have been meant as one feature of each action, and would be known to a prior beforehand."""
    actions = torch.zeros(4, 3, dtype=torch.long)
    features = torch.rand(4, 3, generator=torch.Generator().manual_seed(0))

    def read(context):
        write_plans(Plans(actions, 2, context=context), tmp_path / name)
        found = ReadOptions(num_actions=2).read(str(tmp_path / name))
        assert found.context.shape == expand_context(context, 3).shape
        return found.notes

    (note,) = read(features)
    assert note.startswith("context: 3 features of each plan")
    assert "[N, 3, 1]" in note
    assert not read(features[:, :2])
    assert not read(features[:, :, None])
    assert not read(actions)


FORMULAS = ("=1+1", "+a", "-x", "@sum(b)", "'=c", "''-d", "-1b", "'tis", "rest")


def write_by_plans(plans, path):
    write_plans(plans, path)
    return read_plans(path, action_names=plans.action_names)


def write_by_report(plans, path):
    """A table of a report: a row an action."""
    frame = pd.DataFrame({"behaviour": [plans.action_names[action] for action in plans.actions[0].tolist()]})
    write_frames(path.parent, {path.stem: frame.assign(time=range(9), subject="=m(7)", **{"=x": -1.5})})
    return read(path).plans(action_names=plans.action_names)


@pytest.mark.parametrize("write", [write_by_plans, write_by_report])
def test_names_are_no_formulas_in_a_spreadsheet(write, tmp_path):
    """An apostrophe says so, as spreadsheets have it, and is not read as part of the name."""
    named = {"action_names": FORMULAS, "context_names": ["@home"], "group_names": ["=m(7)"]}
    plans = Plans(torch.arange(9)[None], 9, context=torch.tensor([0]), group=torch.tensor([0]), **named)
    again = write(plans, tmp_path / "a.csv")
    with open(tmp_path / "a.csv", newline="", encoding="utf-8") as file:
        cells = {cell for row in csv.reader(file) for cell in row}
    assert not [cell for cell in cells if cell[0] in "=+@-\t\r" and cell != "-1.5"]
    assert {"'=1+1", "'-x", "''=c", "'''-d", "'tis", "rest", "'=m(7)"} <= cells
    assert again.action_names == FORMULAS
    assert again.actions.equal(plans.actions)
    assert tuple(again.group_names) == ("=m(7)",)
    assert again.context is None or tuple(again.context_names) == ("@home",)


@pytest.mark.parametrize("cell", ["-1", "+2.5", "-1e-3", "-inf", "-", "1", "", "'", "''", "a=b"])
def test_numbers_and_other_names_are_written_as_they_are(cell):
    assert quote_cell(cell) == unquote_cell(cell) == cell
