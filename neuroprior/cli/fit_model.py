"""The `model` section of a recipe: which prior, and how it is optimised."""

from collections.abc import Callable

from neuroprior import Prior
from neuroprior.cli.fit_data import PlansData
from neuroprior.priors.neural.neural import NeuralPrior
from neuroprior.training import PriorModule


class PriorModel(PriorModule):
    """The prior to be trained.

    Args:
        prior: its class, such as `GRUPrior`; its other arguments go below it (`--model.prior.hidden_size 128`). The
            number of actions and of contexts come from the plans.
        see_context: whether it sees the context of the plans, where they have one.
        learning_rate: of AdamW, after the first tenth of the steps; it falls to 0 with half a cosine.
        weight_decay: of AdamW.
        data: the plans.
    """

    def __init__(
        self,
        prior: Callable[[int], Prior],
        see_context: bool = True,
        learning_rate: float = 5e-3,
        weight_decay: float = 0.01,
        data: PlansData | None = None,
    ) -> None:
        assert data is not None
        plans, contexts = data.plans, {}
        if see_context and plans.context is not None:
            if data.num_contexts is None:
                contexts["context_size"] = plans.context.shape[-1]
            else:
                contexts["num_contexts"] = data.num_contexts
        try:
            made = prior(plans.num_actions, **contexts)
        except TypeError as error:
            if contexts and "unexpected keyword" in str(error):
                raise ValueError(
                    "model.prior: it cannot see this context; use --model.see_context false, or another prior"
                    f" ({error})"
                ) from error
            raise
        super().__init__(made, learning_rate, weight_decay, data.seed)

    @property
    def is_neural(self) -> bool:
        """Whether the prior is trained by gradients; others are fitted in one pass of counting."""
        return isinstance(self.prior, NeuralPrior)
