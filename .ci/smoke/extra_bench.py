"""Extra bench: its peers can be imported, and so can the library beside them."""

import mctx
import pomegranate.markov_chain
import transformers
import vlmc

import neuroprior

assert mctx.gumbel_muzero_policy
assert transformers.GPT2LMHeadModel
assert pomegranate.markov_chain.MarkovChain
assert vlmc
assert neuroprior.fit
