"""Markov priors of any order: counts of what followed the last k actions, with back-off to shorter histories."""

from typing import Any, Literal

from torch import Tensor

from neuroprior.priors.counts.backoff import BACKOFFS, Backoff, back_off_probs
from neuroprior.priors.counts.histories import Counts, Tree
from neuroprior.priors.counts.history_prior import HistoryPrior


class MarkovPrior(HistoryPrior):
    """A Markov chain of order k over actions (Hyvärinen, the section on Markov models).

    The probability of action a after the history h of the last k actions leans on that after h', the history without
    its oldest action, the more the less often h occurred; the empty history leans on the uniform distribution. So a
    history never seen takes the probabilities of the longest one that was, and nothing is ever impossible. Sampling
    goes on past the training length with the same probabilities. With n the counts of training and k(h) how many
    different actions followed h, the three ways to lean (`backoff`) are

    - "kneser-ney": p(a | h) = (n(h, a) - D + (sum of all D after h) * p(a | h')) / n(h). There are three discounts D,
      for counts of 1, of 2 and of more, estimated for each length of history from how many counts are 1, 2, 3 and 4. In
      histories shorter than k, n(h, a) is not how often a followed h but after how many different older actions (the
      plan's beginning is one): interpolated modified Kneser-Ney smoothing (Chen and Goodman 1999, section 3).
    - "witten-bell": p(a | h) = (n(h, a) + s * k(h) * p(a | h')) / (n(h) + s * k(h)), with s = `smoothing` (Witten and
      Bell 1991; method C).
    - "dirichlet": p(a | h) = (n(h, a) + s * p(a | h')) / (n(h) + s): s observations are spread like p(a | h') (MacKay
      and Peto 1995).

    On held-out sequences "kneser-ney" was the best or near it without anything to set, above all where the order is
    higher than the plans can fill; the other two come near it with the right `smoothing`.

    With a context index every history is counted apart for each context; (context, empty history) leans on all contexts
    together.

    Args:
        num_actions: A.
        order: k >= 0, the number of past actions that count.
        smoothing: > 0, how much a history leans on the shorter one: s above; of "kneser-ney", a factor on D (which
            stays at most n(h, a)). 1 is the published formula of each.
        initial: the first k actions. "joint": from the distribution of the openings of the plans (which leans on
            "lower"). "lower": action t < k from the chain of order t, wherever in a plan those t actions stood (the
            paper's footnote 2).
        num_contexts: number of context indices, where the prior sees one.
        backoff: "kneser-ney", "witten-bell" or "dirichlet".

    Raises:
        ValueError: an argument is out of range.
    """

    def __init__(
        self,
        num_actions: int,
        order: int = 1,
        smoothing: float = 1.0,
        initial: Literal["joint", "lower"] = "joint",
        num_contexts: int | None = None,
        backoff: Backoff = "kneser-ney",
    ) -> None:
        if not isinstance(order, int) or isinstance(order, bool) or order < 0:
            raise ValueError(f"order: an integer of at least 0 is expected, not {order!r}")
        if not 0 < smoothing < float("inf"):
            raise ValueError(f"smoothing: a positive finite number is expected, not {smoothing!r}")
        if initial not in ("joint", "lower"):
            raise ValueError(f'initial: "joint" or "lower" is expected, not {initial!r}')
        if backoff not in BACKOFFS:
            raise ValueError(f"backoff: one of {', '.join(map(repr, BACKOFFS))} is expected, not {backoff!r}")
        self.order, self.smoothing, self.initial, self.backoff = order, float(smoothing), initial, backoff
        self.openings = initial == "joint"
        super().__init__(num_actions, order, num_contexts)

    @property
    def config(self) -> dict[str, Any]:
        own = {"order": self.order, "smoothing": self.smoothing, "initial": self.initial, "backoff": self.backoff}
        return super().config | own

    def estimate(self, tree: Tree, counts: Counts) -> Tensor:
        return back_off_probs(tree, counts, self.num_contexts, self.num_actions, self.backoff, self.smoothing)

    def transition_matrix(self) -> Tensor:
        """`[A, A]`: the probability of each action (column) after each action (row), wherever in a plan.

        Raises:
            ValueError: the order is 0, or the prior sees a context.
        """
        if self.order == 0 or self.takes_context:
            raise ValueError("transition_matrix: a prior of order 1 or more without context is expected")
        return self.log_probs[self.next_node[0].long()].exp()
