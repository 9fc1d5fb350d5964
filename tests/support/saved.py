"""Priors of every kind that can be saved, after a short fit; models that say something else than was saved."""

import json
from collections.abc import Callable
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load as read_tensors
from safetensors.torch import save as write_tensors

from neuroprior import CombinedPrior, GRUPrior, MarkovPrior, Plans, TransformerPrior, UniformPrior
from neuroprior.behaviour.durations.duration_model import DurationModel
from neuroprior.behaviour.durations.semi_markov import SemiMarkovPrior
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.control import AutoregressivePrior, NoisePrior, StoredWindows, VectorGRU, VectorPlans
from neuroprior.priors import (
    AdaptivePrior,
    ContextTreePrior,
    MixturePrior,
    StackedPrior,
    SwitchingPrior,
    adapt,
    serialization,
)
from neuroprior.priors.saved import SavedModule
from neuroprior.puzzles import LogLinearPrior
from tests.support.sources import seeded

QUICK = {"max_steps": 3, "progress": False}
BOUNDS = ([-1.0, -2.0], [1.0, 3.0])


def content_of(folder: Path) -> dict[str, Any]:
    """What `config.json` says of a saved prior."""
    content: dict[str, Any] = json.loads((folder / "config.json").read_text())
    return content


def rewrite(folder: Path, content: dict[str, Any], tensors: dict[str, torch.Tensor] | None = None) -> None:
    """Write a model with another configuration or other tensors, and the checksums that belong to them."""
    tensors = read_tensors((folder / "model.safetensors").read_bytes()) if tensors is None else tensors
    content = content | {"weights": serialization._checksum_of(tensors)}
    content["sha256"] = serialization._checksum(content)
    (folder / "config.json").write_text(json.dumps(content))
    (folder / "model.safetensors").write_bytes(write_tensors(tensors, {"neuroprior": json.dumps(content)}))


def _plans(context: torch.Tensor | None = None, num: int = 60) -> Plans:
    return Plans(torch.randint(3, (num, 5), generator=seeded(3)), 3, context=context)


def _index() -> torch.Tensor:
    return torch.randint(4, (60, 5), generator=seeded(4))


def _timed() -> RecordedPlans:
    return replace(RecordedPlans.of(_plans()), durations=torch.rand(60, 5, generator=seeded(1)) + 0.1)


def _vectors() -> VectorPlans:
    steps = torch.rand(30, 12, 2, generator=seeded(6)) - 0.5
    return VectorPlans(steps.cumsum(1).clamp(-1, 1), *BOUNDS)


SAVED: dict[str, Callable[[], SavedModule]] = {
    "uniform": lambda: UniformPrior(4),
    "markov": lambda: MarkovPrior(3, 2, smoothing=0.3).fit(_plans()),
    "markov, index": lambda: MarkovPrior(3, 2, num_contexts=4, initial="lower").fit(_plans(_index())),
    "context tree": lambda: ContextTreePrior(3, 3, num_contexts=4).fit(_plans(_index())),
    "context tree that knows zeros": lambda: ContextTreePrior(3, alpha=1e-300).fit(torch.zeros(9, 5, dtype=torch.long)),
    "adaptive": lambda: adapt(AdaptivePrior(MarkovPrior(3, 1), [4.0, inf, 0.5], 0.8).fit(_plans()), _plans()),
    "mixture": lambda: MixturePrior(3, [UniformPrior(3), MixturePrior(3, [MarkovPrior(3, 1)])]).fit(
        _plans(), generator=seeded(0)
    ),
    "combined": lambda: CombinedPrior(3, effort="fast").fit(_plans(num=200), generator=seeded(0), **QUICK),
    "stacked": lambda: StackedPrior(3, 8).fit(_plans(), generator=seeded(0), **QUICK),
    "gru": lambda: GRUPrior(3, 8).fit(_plans(), generator=seeded(0), **QUICK),
    "gru, features, untrained": lambda: GRUPrior(3, context_size=2),
    "transformer": lambda: TransformerPrior(3, 8, num_heads=2, num_contexts=4).fit(
        _plans(_index()), generator=seeded(0), **QUICK
    ),
    "switching": lambda: SwitchingPrior(3, 2, num_contexts=4, phases=2, max_iterations=3, folds=2, restarts=1).fit(
        _plans(_index()), generator=seeded(0)
    ),
    "semi-markov": lambda: SemiMarkovPrior(3).fit(_timed()),
    "durations": lambda: DurationModel(3).fit(_timed()),
    "log-linear": lambda: LogLinearPrior(3, 2).fit(
        _plans(torch.randint(6, (60, 5, 2), generator=seeded(5), dtype=torch.int32))
    ),
    "noise": lambda: NoisePrior(*BOUNDS, exponent=None).fit(_vectors()),
    "autoregressive": lambda: AutoregressivePrior(*BOUNDS).fit(_vectors()),
    "windows": lambda: StoredWindows(*BOUNDS, horizon=4).fit(_vectors()),
    "vector gru": lambda: VectorGRU(*BOUNDS, width=8).fit(_vectors(), generator=seeded(0), **QUICK),
}
