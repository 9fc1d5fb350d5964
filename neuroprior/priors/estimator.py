"""A prior as scikit-learn has its estimators, so that tools for model selection can be used."""

import inspect
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial
from math import log
from typing import Any, Self

import torch
from torch import Tensor

from neuroprior.plans import Plans
from neuroprior.priors.fitting import PRIORS, MakePrior, fit
from neuroprior.priors.matching import match_plans
from neuroprior.priors.prior import Prior


class PriorEstimator:
    """A prior with the methods of scikit-learn's estimators: `fit`, `score`, `get_params`, `set_params`.

    `GridSearchCV` and `cross_val_score` take it, with a list of plans:
    `GridSearchCV(PriorEstimator("markov"), {"order": [0, 1, 2]}).fit(list(plans))`. Plans of a group stay together with
    `cv=GroupKFold()` and `fit(list(plans), groups=plans.group)`. scikit-learn need not be installed to use the class.

    Args:
        prior: a class, a function or a name, as in `neuroprior.fit`.
        num_actions: A, where `fit` is given integers and no `Plans`; None: the largest action + 1.
        seed: of the generator of `fit`.
        settings: arguments of the prior's class, such as `order` or `hidden_size`, and settings of its `fit`, such as
            `max_steps`.

    Attributes:
        prior_: the fitted prior.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 2, 0, 1, 2]]).repeat(20, 1), 3)
        >>> estimator = PriorEstimator("markov", order=1).fit(plans)
        >>> round(estimator.score(plans), 2)
        -0.05
        >>> estimator.set_params(order=2).get_params()["order"]
        2
    """

    prior_: Prior

    def __init__(
        self, prior: MakePrior | str = "combined", *, num_actions: int | None = None, seed: int = 0, **settings: Any
    ) -> None:
        self.prior, self.num_actions, self.seed, self.settings = prior, num_actions, seed, settings

    def __repr__(self) -> str:
        return f"PriorEstimator({', '.join(f'{name}={value!r}' for name, value in self.get_params().items())})"

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """All arguments by name; `deep` changes nothing."""
        return {"prior": self.prior, "num_actions": self.num_actions, "seed": self.seed, **self.settings}

    def set_params(self, **params: Any) -> Self:
        """Change arguments, and return the estimator itself. `fit` checks whether the prior has them."""
        for name, value in params.items():
            if name in ("prior", "num_actions", "seed"):
                setattr(self, name, value)
            else:
                self.settings[name] = value
        return self

    def fit(self, X: Any, y: None = None) -> Self:  # noqa: N803
        """Fit a new prior, `prior_`, and return the estimator itself.

        Args:
            X: `Plans`; a list of `Plans` (`list(plans)`); or integers `[N, L]`.
            y: ignored; scikit-learn passes it.

        Raises:
            ValueError: a setting that the prior does not have, or plans that it cannot learn from.
        """
        make = PRIORS.find(self.prior) or self.prior if isinstance(self.prior, str) else self.prior
        taken = () if isinstance(make, str) else inspect.signature(make).parameters
        own = {name: value for name, value in self.settings.items() if name in taken}
        others = {name: value for name, value in self.settings.items() if name not in taken}
        made = partial(make, **own) if own and not isinstance(make, str) else make
        generator = torch.Generator().manual_seed(self.seed)
        self.prior_ = fit(self._plans(X), made, generator=generator, **others)
        return self

    def score(self, X: Any, y: None = None) -> float:  # noqa: N803
        """The log-likelihood of plans per action, bits: the higher the better, at most 0.

        Args:
            X: as for `fit`; a plan has at least one action.
            y: ignored.

        Raises:
            ValueError: nothing was fitted, or the prior does not know the plans' actions or contexts.
        """
        if not hasattr(self, "prior_"):
            raise ValueError("score: fit the estimator first")
        plans = match_plans(self._plans(X, self.prior_.num_actions), self.prior_)
        with torch.no_grad():
            total = self.prior_.log_prob(plans).double().sum()
        return float(total / log(2) / plans.mask().sum())

    def _plans(self, given: Any, num_actions: int | None = None) -> Plans:
        if isinstance(given, Plans):
            return given
        if isinstance(given, Sequence) and given and all(isinstance(part, Plans) for part in given):
            return _together(given)
        actions = torch.as_tensor(given)
        num_actions = self.num_actions or num_actions
        return Plans(actions, int(actions.max()) + 1 if num_actions is None and actions.numel() else num_actions or 1)

    def __sklearn_tags__(self) -> Any:
        """What scikit-learn asks of its estimators: this one needs no targets."""
        from sklearn.utils import Tags, TargetTags

        return Tags(estimator_type=None, target_tags=TargetTags(required=False))


def _together(parts: Sequence[Plans]) -> Plans:
    """Parts of the same `Plans`, of the same length and names, as one."""
    first = parts[0]
    if any((one.num_actions, one.max_length) != (first.num_actions, first.max_length) for one in parts):
        raise ValueError("X: parts of the same Plans are expected, as in list(plans)")

    def joined(name: str) -> Any:
        values = [getattr(one, name) for one in parts]
        return torch.cat(values) if isinstance(values[0], Tensor) else values[0]

    together = {field.name: joined(field.name) for field in fields(first)}
    if first.plan_names is not None:
        together["plan_names"] = tuple(name for one in parts for name in one.plan_names or ())
    return replace(first, **together)
