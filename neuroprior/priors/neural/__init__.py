"""Neural priors: a gated recurrent network and a transformer."""

from neuroprior.priors.neural.gru import GRUPrior
from neuroprior.priors.neural.neural import NeuralPrior, Sizes
from neuroprior.priors.neural.transformer import TransformerPrior

__all__ = ["GRUPrior", "NeuralPrior", "Sizes", "TransformerPrior"]
