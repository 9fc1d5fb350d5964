"""Each option of `fit`, `report`, `sample` and `score` changes what it says, and nothing else: a table of the options.

How files are read as recordings is in test_flags.py.
"""

import io
import json
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from jsonargparse import ArgumentParser

from neuroprior import Plans, load, save
from neuroprior.__main__ import main
from neuroprior._jobs import JobRun
from neuroprior.behaviour.reading import Options
from neuroprior.behaviour.recorded_plans import action_names
from neuroprior.behaviour.reporting.options import ReadOptions
from neuroprior.cli import fit as command
from neuroprior.cli.reading import SPELLED, add_reading_arguments, pop_reading
from neuroprior.plans import write_plans
from neuroprior.priors import AdaptivePrior
from tests.support.sources import seeded

OTHERS = {
    "fit": {"plans", "resume"},  # tests/cli/test_tables.py; tests/integration/test_train_resume.py
    "report": {"plans"},  # tests/cli/test_tables.py
    "sample": {"folder"},  # tests/cli/test_sample.py
    "score": {"folder", "files"},  # tests/cli/test_score.py
}
"""Arguments that are tested elsewhere."""

COLUMNS = "--columns.behaviour act --columns.subject who --columns.recording id --columns.start from"
COLUMNS += " --columns.stop until"
ROOM = f"{COLUMNS} --columns.context room"

WORLD = "fit --world neuroprior.worlds.gridworld --world.height 3 --world.width 3 --world.num_worlds 5"
WORLD += " --planner neuroprior.planners.ExhaustivePlanner --planner.depth 2 --num_plans 30 --prior markov"
PLAIN = "fit ../plain.npz --prior markov"
CHAIN = f"fit ../data.csv {ROOM} --prior markov --folds 1"
NET = f"fit ../data.csv {COLUMNS} --prior gru --prior.hidden_size 4 --max_steps 6 --check_every 2 --folds 1"
SWITCHING = f"fit ../data.csv {COLUMNS} --prior switching --folds 1"
COMBINED = f"fit ../data.csv {COLUMNS} --prior combined --effort fast --max_steps 2 --folds 1"
COUNTS = f"report ../data.csv {ROOM} --models counts --inputs actions --max_steps 2"
NETS = f"report ../data.csv {COLUMNS} --models combined --effort fast --max_steps 2 --folds 2 --processes 1"
MIXTURE = f"fit ../data.csv {COLUMNS} --prior mixture --max_steps 2 --folds 1"
SAVED = f"report ../data.csv {COLUMNS} --priors ../chain"
SAMPLE = "sample ../rooms --context x"
SCORE = f"score ../adaptive ../data.csv {COLUMNS}"
READ = f"read ../study.csv {COLUMNS} --columns.factors drug sex"

STUDY = """id,who,act,from,until,drug,sex
s1,m1,walk,0,2,low,f
s1,m1,rest,2,3,low,f
s1,m1,walk,9,10,low,f
s2,m2,rest,1,2,saline,f
s2,m2,rear,2,4,saline,f
s3,m3,walk,0,1,high,m
s3,m3,rear,5,6,high,m
s3,m4,rest,0,3,saline,m
"""

LEARNED = {"weights": ..., "trained": ...}
SPLIT = LEARNED | {"baselines": ..., "not held out": ...}
TRAINED = LEARNED | {"curve": ...}
DRIFT = {"scores": ..., "drift": ..., "drift_tests": ...}
SCORED = DRIFT | {"headline": ...}
CHANGED = SCORED | {"lags": ..., "reference": "context tree"}
CONFIG = ("base", "beta", "depth", "backoff", "initial", "order", "smoothing")
TREE = {f"config.{name}": ... for name in CONFIG} | {"prior": "ContextTreePrior", "config.depth": 10}

CASES: list[tuple[str, str, dict[str, Any]]] = [
    # the options beside it, the option, and what of the outcome changes: to which value, or ... for any other
    (PLAIN, "config ../own.yaml", SPLIT | {"sizes.training": 24, "sizes.held_out": 12}),
    (PLAIN, "held_out 0.3", SPLIT | {"sizes.training": 24, "sizes.held_out": 12}),
    (PLAIN, "validation 0.3", LEARNED | {"baselines": ..., "sizes.training": 24, "sizes.validation": 12}),
    (PLAIN, "folds 3", SPLIT | {"folds": 3, "sizes.training": 36, "sizes.held_out": 40, "folds.processes": 1}),
    (PLAIN, "end true", LEARNED | {"baselines": ..., "config.num_actions": 4, "end": 3}),
    (PLAIN, "seed 1", SPLIT),
    (WORLD, "world.height 4", SPLIT | {"plans": ..., "sizes.training": 24, "sizes.validation": 6}),
    (WORLD, "planner.depth 3", SPLIT | {"plans": ..., "longest": 3}),
    (WORLD, "num_plans 41", SPLIT | {
        "plans": ..., "number": 41, "sizes.training": 28, "sizes.validation": 13, "sizes.held_out": 41,
    }),
    (WORLD, "context step", LEARNED | {"baselines": ..., "context": 9, "config.num_contexts": 9}),
    (CHAIN, "prior context-tree", LEARNED | TREE),
    (CHAIN, "use_context false", LEARNED | {"baselines": ..., "config.num_contexts": None}),
    (CHAIN, "orders 0 2", LEARNED | {
        "orders.csv": ["markov-0", "markov-2"], "config.order": 2, "config.backoff": "witten-bell", "files": ...,
    }),
    (CHAIN, "out there/again", {"folders": ["there/again"]}),
    (SWITCHING, "modes 1 3", LEARNED | {"modes.csv": [1, 3], "config.num_modes": 1, "files": ...}),
    (COMBINED, "effort standard", LEARNED | {"config.effort": "standard"}),
    (MIXTURE, "max_steps 4", LEARNED),
    (NET, "past_durations 2", TRAINED | {"config.context_size": 4, "files": ...}),
    (NET, "max_steps 4", TRAINED | {"training.max_steps": 4, "steps": [2, 4]}),
    (NET, "batch_size 5", TRAINED | {"training.batch_size": 5}),
    (NET, "window 4", TRAINED | {"training.window": 4}),
    (NET, "learning_rate 0.02", TRAINED | {"training.learning_rate": 0.02}),
    (NET, "weight_decay 0.5", TRAINED | {"training.weight_decay": 0.5}),
    (NET, "gradient_clip 0.001", TRAINED | {"training.gradient_clip": 0.001}),
    (NET, "check_every 3", TRAINED | {"training.check_every": 3, "steps": [3, 6]}),
    (f"{NET} --learning_rate 1 --patience 9", "patience 1", TRAINED | {"training.patience": 1, "steps": [2, 4]}),
    (NET, "seconds 0", TRAINED | {"training.seconds": 0, "steps": [2]}),
    (NET, "progress false", {"training.progress": False, "says steps": False}),
    (NET, "seed 1", SPLIT | TRAINED | {"training.seed": 1, "sizes.validation": 3, "sizes.held_out": 2}),
    (COUNTS, "test ../more.csv", CHANGED | {"settings.test": "more.csv", "settings.folds": 1}),
    (COUNTS, "folds 3", CHANGED | {"settings.folds": 3}),
    (COUNTS, "skip 2", SCORED | {
        "settings.skip": 2, "how_far_back": ..., "findings": ..., "reference": "context tree",
    }),
    (COUNTS, "seed 1", CHANGED | {"settings.seed": 1}),
    (COUNTS, "modes 1 2", {"settings.modes": [1, 2], "modes": [1, 2], "files": ...}),
    (COUNTS, "dask tcp://x", {"counts.dask": "tcp://x"}),  # the workers are those of tests/test_jobs.py
    (COUNTS, "figures pdf", {
        "files": ..., "folders": ["runs/plans", "runs/plans/figures"],
        "kinds": [".csv", ".graphml", ".gv", ".html", ".json", ".pdf"],
    }),
    (COUNTS, "out there", {"folders": ["there"]}),
    (COUNTS, "inputs actions context", CHANGED | {
        "inputs": ["behaviours", "behaviours and context"], "reference": "context tree, with context",
        "models": ...,
    }),
    (COUNTS, "models counts gru", {
        "settings.models": "counts, gru, lags, gru-lags", "models": ..., "scores": ..., "lags": ...,
    }),
    (NETS, "effort standard", {"settings.effort": "standard", "models": ["gru", "stacked", "combined"]} | DRIFT),
    (NETS, "max_steps 3", {"settings.max_steps": 3, "scores": ..., "lags": ...}),
    (NETS, "processes 3", {"networks.processes": 3}),
    (SAVED, "priors ../adaptive", SCORED | {
        "models": ["../adaptive"], "reference": "../adaptive", "settings.priors": "../adaptive",
        "settings.training data": None,
    }),
    (SAMPLE, "num_plans 3", {"number": 3, "plans": ...}),
    (SAMPLE, "length 4", {"longest": 4, "plans": ...}),
    (SAMPLE, "context y", {"plans": ...}),
    (SAMPLE, "temperature 9", {"plans": ...}),
    (SAMPLE, "seed 1", {"plans": ...}),
    (SAMPLE, "out new.jsonl", {"files": ["new.jsonl"], "folders": ["."], "kinds": [".jsonl"]}),
    (SCORE, "past ../more.csv", {"plans": ..., "m1": ..., "m4": ..., "m6": ...}),
    (SCORE, "out there", {"folders": ["there"]}),
    (READ, "compare sex", {
        "condition": [*"ffmm"], "condition_names": ("f", "m"), "stratum": None, "stratum_names": None, "notes": ...,
    }),
    (f"{READ} --compare drug", "reference low", {"condition_names": ("low", "high", "saline")}),
    (f"{READ} --compare drug", "strata", {"stratum": None, "stratum_names": None}),
    (READ, "max_gap 3.5", {
        "plans": [["walk", "rest"], ["walk"], ["rest", "rear"], ["walk"], ["rear"], ["rest"]],
        "group": ["m1", "m1", "m2", "m3", "m3", "m4"], "stratum": [*"fffmmm"],
        "condition": ["low", "low", "saline", "high", "high", "saline"],
    }),
    (READ, "action_names walk rest rear groom", {
        "action_names": ("walk", "rest", "rear", "groom"), "num_actions": 4,  # and the plans have the same names
    }),
    (f"{READ} --action_names walk rest --unknown gap", "unknown error", {"error": ...} | dict.fromkeys((
        "plans", "notes", "action_names", "num_actions", "group", "group_names", "condition", "condition_names",
        "stratum", "stratum_names",
    ))),
    ("read ../numbers.csv --columns.behaviour act", "num_actions 5", {"num_actions": 5, "notes": ...}),
]  # fmt: skip


def write_table(path: Path, subjects: list[int], seed: int) -> None:
    """Subjects with one to three sessions of unequal lengths, some with a pause, in two rooms."""
    rng, rows, session = np.random.default_rng(seed), ["id,who,act,from,until,room"], 0
    for who in subjects:
        for _ in range(1 + who % 3):
            session, now, act = session + 1, 0.0, 0
            for k in range(8 + (5 * who + 3 * session) % 9):
                act, took = (act + 1 + int(rng.random() < 0.2)) % 3, 0.5 + act + float(rng.exponential())
                name, room = ["walk", "rest", "rear"][act], "xy"[(k + who) % 3 // 2]
                rows.append(f"s{session},m{who},{name},{now:.2f},{now + took:.2f},{room}")
                now += took + 9 * (k == 5)
    path.write_text("\n".join(rows) + "\n")


def fit_outcome(place: Path) -> dict[str, Any]:
    """What a run of `fit` made."""
    (folder,) = {path.parent for path in place.rglob("config.json")}
    saved, results = (json.loads((folder / f"{name}.json").read_text()) for name in ("config", "metrics"))
    plans = ReadOptions().read(folder / "plans.npz")
    values = {f"config.{name}": value for name, value in saved["config"].items()}
    values |= {f"sizes.{part}": size for part, size in results["plans"].items()}
    for file in {"orders.csv", "modes.csv"} & {path.name for path in folder.iterdir()}:
        values[file] = pd.read_csv(folder / file).iloc[:, 0].tolist()
    values |= {name: results[name] for name in ("folds", "curve")}
    values |= {name: saved[name] for name in ("prior", "weights")}
    values |= {"plans": plans.actions.tolist(), "number": len(plans), "longest": plans.max_length}
    values["context"] = None if plans.context is None else len(plans.context.unique())
    values["not held out"] = json.loads((folder / "learned.json").read_text())["plans"]
    scores = [(row["model"], row["context"], row["how"], row["bits_per_action"]) for row in results["rows"]]
    values |= {"baselines": scores[:-1], "trained": scores[-1], "steps": [row["step"] for row in results["curve"]]}
    return values | {"end": saved["learned"]["end"]}


def report_outcome(place: Path) -> dict[str, Any]:
    """What a report found."""
    (file,) = place.rglob("results.json")
    results = json.loads(file.read_text())
    values = {f"settings.{name}": value for name, value in results.pop("settings").items()}
    values |= {"modes": [row["modes"] for row in results.pop("modes", [])]}
    values |= {f"{name}s": [row[name] for row in results["scores"]] for name in ("model", "input")}
    return values | results | {"inputs": sorted({*values["inputs"]})}


def score_outcome(place: Path) -> dict[str, Any]:
    """Log-likelihoods of plans, and of each animal by its name."""
    plans, groups = (pd.read_csv(next(place.rglob(f"{name}.csv"))) for name in ("plans", "groups"))
    values = {"actions": plans["actions"].tolist(), "plans": plans["log_likelihood"].tolist()}
    return values | dict(zip(groups["group"], groups["log_likelihood"], strict=True))


def read_outcome(words: list[str]) -> dict[str, Any]:
    """The plans that a file is read as, with names for numbers."""
    parser = ArgumentParser(exit_on_error=False)
    add_reading_arguments(parser, ReadOptions)
    try:
        plans = pop_reading(parser.parse_args(words[2:]).as_dict(), ReadOptions).read(words[1])
    except ValueError as error:
        return {"error": str(error)}
    actions = [row[mask].tolist() for row, mask in zip(plans.actions, plans.mask(), strict=True)]
    values = {"plans": [[action_names(plans)[action] for action in row] for row in actions], "notes": plans.notes}
    for name in ("group", "condition", "stratum"):
        numbers, names = getattr(plans, name), getattr(plans, f"{name}_names")
        values |= {name: None if numbers is None else [names[number] for number in numbers], f"{name}_names": names}
    return values | {"num_actions": plans.num_actions, "action_names": plans.action_names}


@pytest.fixture(scope="module")
def outcome(tmp_path_factory, undrawn):
    """A function that runs a command line in a folder of its own, once, and returns what came of it, by name."""
    top, known = tmp_path_factory.mktemp("commands"), {}
    write_table(top / "data.csv", [*range(9)], 0)
    write_table(top / "more.csv", [1, 4, 6], 1)
    lengths = torch.arange(40) % 6 + 2
    write_plans(Plans(torch.randint(3, (40, 7), generator=seeded(0)), 3, lengths), top / "plain.npz")
    (top / "study.csv").write_text(STUDY)
    (top / "numbers.csv").write_text("plan,act\n1,0\n1,2\n2,1\n")
    (top / "own.yaml").write_text("held_out: 0.3\n")

    def run(words: str) -> dict[str, Any]:
        if words in known:
            return known[words]
        place, values = top / f"run{sum(1 for _ in top.iterdir())}", {}
        place.mkdir()
        train, each = command.train, JobRun.each

        def spied_train(prior, plans, how, *rest):
            values.update({f"training.{name}": value for name, value in vars(how).items() if name != "validation"})
            values["training.seed"] = rest[0]
            return train(prior, plans, how, *rest)

        def spied_each(self, jobs, **how):
            values.update({f"{how['title']}.{name}": how[name] for name in ("processes", "dask")})
            return each(self, jobs, **how | {"processes": 1, "dask": None})

        with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as said:
            patch.chdir(place)
            patch.setattr(command, "train", spied_train)
            patch.setattr(JobRun, "each", spied_each)
            patch.setattr("neuroprior.training.trainer.MIN_SECONDS", 0)  # a line of progress at each validation
            name = words.split()[0]
            if name == "read":
                return known.setdefault(words, read_outcome(words.split()))
            with redirect_stderr(io.StringIO()) as errors:
                assert main(words.split()) == 0, errors.getvalue()
        files = [path for path in place.rglob("*") if path.is_file() and not {"folds", "tensorboard"} & {*path.parts}]
        values["files"] = sorted(path.name for path in files)
        values["folders"] = sorted({str(path.parent.relative_to(place)) for path in files})
        values["kinds"] = sorted({path.suffix for path in files})
        values["says steps"] = "training: step" in errors.getvalue()
        if name == "sample":
            lines = (files[0].read_text() if files else said.getvalue()).splitlines()[1:]
            plans = [json.loads(line)["actions"] for line in lines]
            values |= {"plans": plans, "number": len(plans), "longest": max(map(len, plans))}
        else:
            values |= {"fit": fit_outcome, "report": report_outcome, "score": score_outcome}[name](place)
        return known.setdefault(words, values)

    for name, how in ("chain", COLUMNS), ("rooms", ROOM):
        assert main(f"fit {top}/data.csv {how} --prior markov --folds 1 --out {top}/{name}".split()) == 0
    save(AdaptivePrior(load(top / "chain"), [4.0, 2.0]), top / "adaptive")
    return run


@pytest.mark.parametrize("name", OTHERS)
def test_no_option_is_left_out(name, monkeypatch):
    parsers = []

    def keep(parser, *_):
        parsers.append(parser)
        raise ValueError

    monkeypatch.setattr(ArgumentParser, "parse_args", keep)
    assert main([name]) == 2
    options = vars(parsers[0].get_defaults())
    tested = OTHERS[name] | {option.split()[0].split(".")[0] for beside, option, _ in CASES
                             if beside.split()[0] in (name, *["read"] * ("columns" in options))}  # fmt: skip
    if "columns" in options:
        tested |= {SPELLED.get(field.name, field.name) for field in fields(Options)}
    assert tested == {*options}


@pytest.mark.parametrize(("beside", "option", "changes"), CASES, ids=[f"{one[0].split()[0]} {one[1]}" for one in CASES])
def test_an_option_changes_what_it_says_and_nothing_else(beside, option, changes, outcome):
    without, values = outcome(beside), outcome(f"{beside} --{option}")
    assert {name for name in {*without, *values} if without.get(name) != values.get(name)} == {*changes}
    predicted = {name: value for name, value in changes.items() if value is not ...}
    assert {name: values.get(name) for name in predicted} == predicted


READING = "--max_gap 3.5 --compare sex --reference m --strata drug --num_actions 3 --action_names a b c --unknown gap"


@pytest.mark.parametrize("words", ["fit ../study.csv", "report ../study.csv", "score ../chain ../study.csv"])
def test_how_files_are_read_is_passed_on(words, outcome, monkeypatch):
    passed = []

    def keep(options, recordings):
        passed.append(options)
        raise ValueError("enough")

    monkeypatch.setattr(ReadOptions, "plans", keep)
    with pytest.raises(AssertionError, match="enough"):
        outcome(f"{words} {COLUMNS} {READING}")
    due = {"max_gap": 3.5, "compare": "sex", "reference": "m", "strata": ["drug"], "num_actions": 3}
    due |= {"action_names": ["a", "b", "c"], "unknown": "gap"}
    assert vars(passed[0]) == vars(ReadOptions(columns=passed[0].columns, **due))
