"""The LightningModule that trains a prior: its loss, bits per action, its optimiser, and its learning curve."""

from math import cos, log, pi
from typing import Any

import lightning
import torch
from torch import Tensor, nn

from neuroprior.sampling.states import State, map_state
from neuroprior.training.batches import Batch


class PriorModule(lightning.LightningModule):
    """The loss of a prior, bits per action, and its optimiser.

    Args:
        prior: any module with `forward(plans, context) -> logits [N, L, A]`; for plans longer than a window it needs
            `forward_from` too, see `NeuralPrior`. For vectors, one with `log_probs_from`, see `VectorGRU`.
        learning_rate: of AdamW, after the first tenth of the steps; it falls to 0 with half a cosine.
        weight_decay: of AdamW.
        seed: of dropout.

    Attributes:
        curve: one entry an epoch: step, learning_rate, train_bits and validation_bits (bits per action); saved in
            checkpoints.
    """

    def __init__(
        self, prior: nn.Module, learning_rate: float = 5e-3, weight_decay: float = 0.01, seed: int = 0
    ) -> None:
        super().__init__()
        self.prior, self.learning_rate, self.weight_decay, self.seed = prior, learning_rate, weight_decay, seed
        self.curve: list[dict[str, float]] = []
        self._hidden: State | None = None

    def on_train_epoch_start(self) -> None:
        self.prior.train()
        self._totals = torch.zeros(2, device=self.device)  # on the device: a step should not wait for it

    def training_step(self, batch: Batch, batch_index: int) -> Tensor:
        # Dropout is seeded anew in each step, so that a resumed training draws the same.
        seed = hash((self.seed, self.current_epoch, batch_index, 0)) % 2**63
        if self.device.type == "cpu":
            torch.default_generator.manual_seed(seed)  # `torch.manual_seed` takes far longer: it minds all accelerators
        else:
            torch.manual_seed(seed)
        total, weight, self._hidden = bits(self.prior, batch, self._hidden)
        loss = total / weight.clamp(min=1)
        self._totals += torch.stack([total.detach(), weight])
        # To log takes a tenth of a small step: only where somebody reads it.
        if self.trainer.loggers or self.trainer.progress_bar_callback is not None:
            self.log("train_bits", loss, prog_bar=True, batch_size=1)
        return loss

    def on_validation_epoch_start(self) -> None:
        self.prior.eval()
        self._held_out = torch.zeros(2, dtype=torch.double)

    def validation_step(self, batch: Batch, batch_index: int) -> None:
        total, weight, self._hidden = bits(self.prior, batch, self._hidden)
        self._held_out += torch.stack([total, weight]).cpu()  # not every device has float64

    def on_validation_epoch_end(self) -> None:
        held_out = float(self._held_out[0] / self._held_out[1].clamp(min=1))
        trained = float(self._totals[0] / self._totals[1].clamp(min=1))
        rate = self.trainer.optimizers[0].param_groups[0]["lr"]
        self.log_dict({"validation_bits": held_out, "learning_rate": rate})
        entry = {"step": self.global_step, "learning_rate": rate, "train_bits": trained}
        self.curve.append(entry | {"validation_bits": held_out})

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["curve"] = list(self.curve)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.curve = list(checkpoint["curve"])

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.AdamW(self.parameters(), lr=self.learning_rate, weight_decay=self.weight_decay)
        steps = self.trainer.estimated_stepping_batches
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: _rate(step / steps))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def bits(prior: nn.Module, batch: Batch, hidden: State | None = None) -> tuple[Tensor, Tensor, State | None]:
    """The loss of a prior on a batch.

    Args:
        prior: the prior.
        batch: what is read.
        hidden: the hidden state after the batch before, used where this batch continues it.

    Returns:
        The weighted sum of bits, the sum of the weights, and the hidden state for the next batch (None for whole
        plans).
    """
    taken, hidden = _log_probs(prior, batch, hidden if batch.continues else None)
    hidden = None if hidden is None or batch.previous is None else map_state(torch.detach, hidden)
    return -(taken * batch.weight).sum() / log(2), batch.weight.sum(), hidden


def _log_probs(prior: Any, batch: Batch, hidden: State | None) -> tuple[Tensor, State | None]:
    """Nats `[N, T]` of a batch's actions, and the hidden state after them."""
    if batch.actions.is_floating_point():
        taken, hidden = prior.log_probs_from(batch.actions, batch.context, batch.previous, hidden)
        return taken, hidden
    if batch.previous is None:
        logits = prior(batch.actions, batch.context)
    else:
        logits, hidden = prior.forward_from(batch.actions, batch.context, batch.previous, hidden)
    log_probs = torch.log_softmax(logits.float(), -1)
    return log_probs.gather(-1, batch.actions.long()[..., None])[..., 0], hidden


def _rate(done: float) -> float:
    """The factor on the learning rate after a share `done` of the steps: linear warm-up over a tenth, half a cosine."""
    return min((done + 1e-3) / 0.1, 0.5 * (1 + cos(pi * min(done, 1.0))))
