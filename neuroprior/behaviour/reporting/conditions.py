"""The section on conditions: whether behaviour differs between them, and in what."""

from collections.abc import Mapping

import pandas as pd
import torch

from neuroprior._statistics import LEVEL, interval_words, p_words
from neuroprior.behaviour.analysis.conditions import (
    ConditionComparison,
    ConditionFamily,
    ConditionPrediction,
    compare_conditions,
    feature_names,
)
from neuroprior.behaviour.analysis.interaction import ConditionInteraction
from neuroprior.behaviour.recorded_plans import action_names, group_names
from neuroprior.behaviour.reporting import figures
from neuroprior.behaviour.reporting.document import Column, table
from neuroprior.behaviour.reporting.findings import Finding
from neuroprior.behaviour.reporting.page import FigureBox, Section, Table
from neuroprior.behaviour.reporting.part import LISTED, Part, p_text
from neuroprior.behaviour.reporting.scores import Evaluation
from neuroprior.plans.columns import listed

DRAWN = 8  # features in the figure

TESTS = {
    "behaviours": "shares of behaviours",
    "transitions": "transition probabilities",
    "sequences": "shares of sequences of three",
    "durations": "durations of behaviours",
    "bits": "bits saved by knowing the condition",
    "classifier": "condition predicted from sequences",
}


def condition_section(evaluation: Evaluation) -> Part | None:
    """Whether behaviour differs between conditions; None where plans have none."""
    if evaluation.plans.condition is None:
        return None
    result = compare_conditions(evaluation.plans, generator=torch.Generator().manual_seed(0))
    names = ["condition_tests", "conditions", "condition_blocks"]
    if result.prediction is None:
        empty = {name: pd.DataFrame() for name in names}
        return Part(Section("Conditions", [result.verdict]), empty, [result.verdict])
    actions, units = action_names(evaluation.plans), _unit_names(result, evaluation)
    tests, features = _tests(result), result.frame()
    blocks = _blocks(result, result.prediction, units)
    frames = dict(zip(names, (tests, features.drop(columns="parts"), blocks), strict=True))
    tables = [
        _test_table(result, tests),
        _feature_table(result, features),
        _block_table(result, result.prediction, blocks),
    ]
    if result.contrasts:
        frames["condition_pairs"] = _pairs(result)
        tables.append(_pair_table(result, frames["condition_pairs"]))
    if result.interaction is not None:
        frames["condition_interaction"] = _interaction(result.interaction, actions)
        tables.append(_interaction_table(result.interaction, frames["condition_interaction"]))
    box = _figure_box(result, features, units)
    unit = evaluation.recordings.unit if evaluation.recordings is not None else ""
    findings = [*_feature_findings(result, features, unit), *_prediction_findings(result, result.prediction)]
    verdicts = [result.verdict]
    if result.contrasts:
        findings += _pair_findings(frames["condition_pairs"])
    if result.interaction is not None:
        findings += _interaction_findings(result.interaction, frames["condition_interaction"])
        verdicts.append(result.interaction.verdict)
    return Part(Section("Conditions", _text(result), tables, [box]), frames, verdicts, findings)


SENTENCES = {
    "transitions": "After {0}, {1} follows in {means}",
    "durations": "A bout of {0} lasts {means} (geometric means)",
    "behaviours": "Of all behaviours, by count, {0} is {means}",
    "sequences": "Of all sequences of three {all} is {means}",
}
"""How the features of each family are said; `means` are those under each condition."""


def _feature_findings(result: ConditionComparison, features: pd.DataFrame, unit: str) -> list[Finding]:
    """A finding for each feature; `unit` is that of durations."""
    two, findings = len(result.condition_names) == 2, []
    for row in features.to_dict("records"):
        family, parts, of_time = row["family"], row["parts"], row["family"] == "durations"
        scale, suffix = (1, f" {unit}".rstrip()) if of_time else (100, " %")
        ordered = [*reversed(result.condition_names)] if two else result.condition_names  # the reference comes last
        means = listed([f"{scale * row[f'mean, {name}']:.3g}{suffix} under {name}" for name in ordered])
        p_corrected = row["p_corrected"]
        sentence = SENTENCES[family].format(*parts, all=" ".join(parts), means=means)
        effect = low = high = None
        if two:
            effect, low, high = row["difference"], row["low"], row["high"]
            by = f"{effect:.3g} times" if of_time else f"difference {100 * effect:+.3g} %"
            form = ".3g" if of_time else "+.3g"
            sentence += f": {by}" + interval_words(scale * low, scale * high, form, ", 95 % interval ")
        sentence += f"; {p_words(p_corrected)}."
        name = f"{family}: {row['feature']}"
        p = float(row["p_value"])
        findings.append(
            Finding(name, family, row["feature"], effect, low, high, p, p_corrected, row["significant"], sentence)
        )
    return findings


def _pair_findings(pairs: pd.DataFrame) -> list[Finding]:
    """A finding for each feature of each two conditions."""
    findings = []
    for row in pairs.to_dict("records"):
        pair = f"{row['second']} against {row['first']}"
        of_time = row["family"] == "durations"
        by = f"{row['difference']:.3g} times" if of_time else f"difference {row['difference']:+.3g}"
        p_corrected = row["p_corrected"]
        interval = interval_words(row["low"], row["high"], ".3g", ", 95 % interval ")
        sentence = f"{pair[0].upper()}{pair[1:]}, {row['feature']}: {by}{interval}; {p_words(p_corrected)}."
        name, family = f"{row['feature']}, {pair}", f"{row['family']}, {pair}"
        estimate = (row["difference"], row["low"], row["high"], float(row["p_value"]))
        starred = bool(row["significant"])
        findings.append(Finding(f"{row['family']}: {name}", family, name, *estimate, p_corrected, starred, sentence))
    return findings


def _interaction_findings(result: ConditionInteraction, frame: pd.DataFrame) -> list[Finding]:
    """A finding for each feature whose difference between conditions may depend on the stratum."""
    findings = []
    for row in frame.to_dict("records"):
        of_time = row["family"] == "durations"
        differences = listed(
            [
                f"{row[f'difference, {name}']:{'' if of_time else '+'}.3g}{' times' * of_time} in {name}"
                for name in result.stratum_names
            ]
        )
        p_corrected = row["p_corrected"]
        name = f"{row['feature']}, by stratum"
        sentence = f"The difference in {row['feature']} depends on the stratum ({differences}; {p_words(p_corrected)})."
        family, p = f"{row['family']}, by stratum", float(row["p_value"])
        starred = bool(row["significant"])
        findings.append(
            Finding(f"{row['family']}: {name}", family, name, None, None, None, p, p_corrected, starred, sentence)
        )
    return findings


def _prediction_findings(result: ConditionComparison, prediction: ConditionPrediction) -> list[Finding]:
    """What knowing the condition saves, and how often the condition is told from the sequences."""
    mean, low, high, _ = prediction.gain
    right, expected = 100 * prediction.accuracy, 100 * prediction.expected
    item = result.design.item
    interval = f"95 % interval {low:.3g} to {high:.3g} over {item}"
    saved = f"Knowing the condition saves {mean:.3g} bits per behaviour, {interval}"
    told = f"From its sequences, {right:.0f} % of the {item} are given their own condition ({expected:.0f} % by chance)"
    findings = []
    for name, effect, least, most, sentence in (
        ("bits", mean, low, high, saved),
        ("classifier", prediction.accuracy, None, None, told),
    ):
        p, corrected = result.tests[name]
        starred, text = result.differs(name), f"{sentence}; {p_words(corrected)}."
        findings.append(Finding(name, name, TESTS[name], effect, least, most, p, corrected, starred, text))
    return findings


def _text(result: ConditionComparison) -> list[str]:
    design, item = result.design, result.design.item
    how = (
        f"Each of the {item} is under one condition: conditions were permuted among {item}."
        if design.kind == "between"
        else f"Each of the {item} is under every condition: conditions were permuted within {item}."
    )
    if len(design.strata) > 1 and design.kind == "between":
        how += f" They were permuted within {len(design.strata)} strata, whose differences do not count."
    return [
        result.verdict,
        f"{how} Sequences of one unit under one condition always stay together, so that it does not matter how alike"
        f" they are. {'All' if result.exact else 'Random'} labellings that were compared, with the observed one:"
        f" {' '.join([f'{result.labellings:,}.', *design.notes])}",
        "Families of features are tested by their most different feature (Westfall and Young); the tests are corrected"
        " for their number (step-down minP). Behaviour differs where one of them is significant. The p-value of a"
        " feature is corrected for the features of its family, and no smaller than that of the family. Rates of rare"
        " features are smoothed towards those of all.",
    ]


def _unit_names(result: ConditionComparison, evaluation: Evaluation) -> list[str]:
    if result.design.item == "sequences":
        names = evaluation.plans.recording or ()
        distinct = len(set(names)) == len(evaluation.plans)
        return [names[number] if distinct else f"sequence {number}" for number in result.design.units.tolist()]
    return group_names(evaluation.plans, result.design.units)


def _tests(result: ConditionComparison) -> pd.DataFrame:
    sizes = {family.name: len(family.features) for family in result.families}
    rows: list[tuple[object, ...]] = [("all", pd.NA, result.p_value, result.p_value)]
    rows += [(name, sizes.get(name, 1), *p_values) for name, p_values in result.tests.items()]
    frame = pd.DataFrame(rows, columns=["test", "features", "p_value", "p_corrected"])
    return frame.astype({"features": "Int64"}).assign(smallest_p=result.smallest_p)


def _test_table(result: ConditionComparison, tests: pd.DataFrame) -> Table:
    columns: Mapping[str, Column] = {
        "test": lambda row: TESTS.get(row.test, "all tests together"),
        "features": "features:,",
        "p": lambda row: f"{row.p_value:.2g}",
        "p corrected": lambda row: (
            "" if row.test == "all" else f"{row.p_corrected:.2g}" + "*" * result.differs(row.test)
        ),
    }
    prediction = result.prediction
    assert prediction is not None
    mean, low, high, _ = prediction.gain
    caption = (
        f"Smallest possible p: {result.smallest_p:.2g}. *: p < 0.05, corrected for the {len(result.tests)} tests (the"
        " smallest p of all in each labelling: Westfall and Young). A Markov chain that knows the condition saves"
        f" {mean:+.4f} bits per held-out behaviour (95 % interval {low:+.4f} to {high:+.4f} over"
        f" {result.design.item}; the test asks whether other labellings save as much, not whether this is above 0)."
    )
    return table(tests, columns, caption, "Do conditions differ?")


def _feature_table(result: ConditionComparison, features: pd.DataFrame) -> Table:
    columns: dict[str, Column] = {"feature": "feature"}
    for name in result.condition_names:
        columns[f"mean,\n{name}"] = _cell_of(f"mean, {name}", ".3g")
    if len(result.condition_names) == 2:
        first, second = result.condition_names
        columns[f"{second}\nagainst {first}"] = lambda row: (
            f"{row.difference:{_sign(row)}.3g}" + " times" * (not _sign(row))
        )
        columns["95 % interval"] = lambda row: interval_words(row.low, row.high, f"{_sign(row)}.3g")
    columns["p"] = lambda row: p_text(row.p_corrected) + "*" * row.significant
    shown = features[:LISTED]
    caption = (
        f"{len(shown)} of {len(features):,} features: *: significant; then those that differ most. Transitions are"
        f" probabilities, sequences shares of all; means over {result.design.item}. Durations are geometric means and"
        " ratios. p: corrected for the features of a family and for the families; intervals are not."
    )
    return table(shown, columns, caption, "What differs")


def _pairs(result: ConditionComparison) -> pd.DataFrame:
    """The features of each two conditions, as of `_features`, with both in the columns `first` and `second`."""
    parts = []
    for pair in result.contrasts:
        first, second = pair.condition_names
        frame = pair.frame().rename(columns={f"mean, {first}": "mean_first", f"mean, {second}": "mean_second"})
        parts.append(frame.assign(first=first, second=second))
    columns = ["first", "second", "family", "feature", "mean_first", "mean_second", "difference", "low", "high"]
    return pd.concat(parts)[[*columns, "p_value", "p_corrected", "significant"]]


def _pair_table(result: ConditionComparison, pairs: pd.DataFrame) -> Table:
    """For each two conditions the features that differ most."""
    columns: dict[str, Column] = {
        "conditions": lambda row: f"{row['second']}\nagainst {row['first']}",
        "feature": "feature",
        "difference": lambda row: f"{row.difference:{_sign(row)}.3g}" + " times" * (not _sign(row)),
        "95 % interval": lambda row: interval_words(row.low, row.high, f"{_sign(row)}.3g"),
        "p": lambda row: p_text(row.p_corrected) + "*" * row.significant,
    }
    number = max(LISTED // len(result.contrasts), 1)
    shown = pairs.groupby(["first", "second"], sort=False).head(number)
    caption = (
        f"The {number} features of each two conditions that differ most. p: corrected for the features of a family, the"
        " pairs, and the test of all conditions. *: p < 0.05."
    )
    return table(shown, columns, caption, "Each two conditions")


def _interaction(interaction: ConditionInteraction, actions: list[str]) -> pd.DataFrame:
    """A row a feature, with the difference between two conditions in each stratum."""
    parts = []
    for family in interaction.families:
        parts_of = [[actions[action] for action in feature] for feature in family.features.tolist()]
        frame = pd.DataFrame({"family": family.name, "feature": feature_names(family.name, parts_of)})
        differences = family.differences.exp() if family.name == "durations" else family.differences
        for name, difference in zip(interaction.stratum_names, differences, strict=True):
            frame[f"difference, {name}"] = difference.numpy()
        frame["p_value"] = family.p_values.numpy()
        frame["p_corrected"] = family.corrected.clamp(min=interaction.tests[family.name][1]).numpy()
        parts.append(frame.assign(significant=frame["p_corrected"] < LEVEL))
    return pd.concat(parts, ignore_index=True).sort_values(["p_corrected", "p_value"], kind="stable", ignore_index=True)


def _interaction_table(interaction: ConditionInteraction, frame: pd.DataFrame) -> Table:
    columns: dict[str, Column] = {"feature": "feature"}
    for name in interaction.stratum_names:
        columns[f"difference,\n{name}"] = _cell_of(f"difference, {name}", ".3g")
    columns["p"] = lambda row: p_text(row.p_corrected) + "*" * row.significant
    caption = (
        f"{interaction.verdict} Durations are ratios. p: corrected for the features of a family and for the families."
    )
    caption += " *: p < 0.05."
    return table(frame[:LISTED], columns, caption, "Do differences depend on the stratum?")


def _cell_of(name: str, form: str) -> Column:
    """A column by its name, which may hold a colon."""
    return lambda row: format(row[name], form)


def _sign(row: pd.Series) -> str:
    """Differences have a sign, ratios have none."""
    return "" if row["family"] == "durations" else "+"


def _blocks(result: ConditionComparison, prediction: ConditionPrediction, units: list[str]) -> pd.DataFrame:
    """A row for each unit and condition: the condition that it was given, and the log odds of each."""
    names, design = result.condition_names, result.design
    odds = prediction.log_odds
    frame = pd.DataFrame({design.item[:-1]: [units[unit] for unit in design.unit.tolist()]})
    frame["condition"] = [names[label] for label in design.label.tolist()]
    frame["classified"] = [names[label] for label in odds.argmax(1).tolist()]
    return frame.assign(**{f"log odds, {name}": column.numpy() for name, column in zip(names, odds.T, strict=True)})


def _block_table(result: ConditionComparison, prediction: ConditionPrediction, blocks: pd.DataFrame) -> Table:
    """How many units of each condition were given which."""
    names, item = result.condition_names, result.design.item
    counts = pd.crosstab(blocks["condition"], blocks["classified"]).reindex(index=names, columns=names, fill_value=0)
    columns: dict[str, Column] = {"condition": lambda row: str(row.name)}
    columns |= {f"predicted\n{name}": _cell_of(name, "") for name in names}
    caption = (
        f"Held-out {item}, under the condition in which their sequences are most likely (Markov chains):"
        f" {100 * prediction.accuracy:.0f} % are right on average over conditions, {100 * prediction.expected:.0f} % in"
        f" permutations ({p_words(prediction.p_value)}, not corrected)."
    )
    return table(counts, columns, caption, "Condition predicted from sequences")


def _figure_box(result: ConditionComparison, features: pd.DataFrame, units: list[str]) -> FigureBox:
    """The features that differ most, with a dot for each unit."""
    design, families = result.design, {family.name: family for family in result.families}
    shown, means, values = features.drop_duplicates("feature")[:DRAWN], [], []
    for row in shown.to_dict("records"):
        unit_values = _values(families[row["family"]], row["place"])
        name = row["feature"] + "*" * row["significant"]
        for unit, label, value in zip(design.unit.tolist(), design.label.tolist(), unit_values, strict=True):
            values.append((name, units[unit], result.condition_names[label], value))
        for condition in result.condition_names:
            means.append((name, condition, *(row[f"{what}, {condition}"] for what in ("mean", "low", "high"))))
    figure = figures.condition_figure(
        pd.DataFrame(means, columns=["feature", "condition", "mean", "low", "high"]),
        pd.DataFrame(values, columns=["feature", "unit", "condition", "value"]),
        paired=design.kind == "within",
    )
    lines = "; lines join those of one" if design.kind == "within" else ""
    caption = (
        f"The {len(shown)} features that differ most, each on an axis of its own. Dots: {design.item}{lines}. Bars:"
        f" means with 95 % intervals over {design.item}. *: significant."
    )
    alt = "Features that differ most between conditions: " + "; ".join(shown["feature"][:5])
    return FigureBox(figure, caption, alt, "conditions")


def _values(family: ConditionFamily, place: int) -> list[float]:
    values = family.values[:, place]
    numbers: list[float] = (values.exp() if family.name == "durations" else values).tolist()
    return numbers
