"""The jobs of `python -m eval bench`: what the library does in each, its peers, and how far ahead it should be."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from eval.bench import packages as bench_packages
from eval.bench import peers as bench_peers
from eval.bench.packages import Run
from eval.bench.training import TrainingRace
from eval.paper.first_simulation import Protocol, Size, simulate
from neuroprior import (
    ContextTreePrior,
    GRUPrior,
    MarkovPrior,
    SamplingPlanner,
    TransformerPrior,
    UniformPrior,
    from_gymnasium,
    gridworld,
)

FOUR_ROOMS = "MiniGrid-FourRooms-v0"


@dataclass(frozen=True)
class Peer:
    """What a user would take in place of the library.

    Attributes:
        name: as in the tables.
        make: prepares it; what it returns is timed.
        share: of the job's work that it does, for peers that would take minutes for all of it.
        goal: how many times as long it should take as the library.
        needs: the package without which it is left out; None: it is always there.
    """

    name: str
    make: Callable[[], Run]
    goal: float
    share: float = 1.0
    needs: str | None = None


@dataclass(frozen=True)
class Job:
    """A piece of work that is timed.

    Attributes:
        about: as in the tables.
        make: prepares it on a device; what it returns is timed.
        peers: the rivals in the same run, which know the CPU alone.
        needs: the package without which it is left out; None: it is always there.
    """

    about: str
    make: Callable[[torch.device], Run]
    peers: tuple[Peer, ...]
    needs: str | None = None


def sample_short(scale: float) -> Job:
    """Many short plans, which share their beginnings."""
    return _against_generate(scaled(2_560_000, scale), 8, [scaled(size, scale) for size in (1024, 8192, 65_536)], 500)


def sample_long(scale: float) -> Job:
    """Long plans, of which hardly two begin alike."""
    return _against_generate(scaled(8192, scale), 64, [scaled(size, scale) for size in (512, 2048, 8192)], 10)


def _against_generate(number: int, length: int, batches: list[int], goal: float) -> Job:
    """A transformer samples, against one of another package in batches of several sizes."""
    peers = [
        Peer(
            f"transformers generate, {batch:,} at once",
            partial(bench_packages.transformers_generate, 4, length, batch),
            goal,
            batch / number,
            "transformers",
        )
        for batch in sorted(set(batches))
    ]
    about = f"sample {number:,} plans of length {length}, transformer"
    return Job(about, lambda device: partial(TransformerPrior(4).to(device).sample, number, length), tuple(peers))


def sample_gru(scale: float) -> Job:
    """Long plans of a GRU."""
    number = scaled(8192, scale)
    plain = Peer("plain PyTorch", lambda: partial(bench_peers.PlainGRU(4).eval().sample, number, 64), 3)
    return Job(
        f"sample {number:,} plans of length 64, GRU",
        lambda device: partial(GRUPrior(4, lags=1).to(device).sample, number, 64),
        (plain,),
    )


def sample_markov(scale: float) -> Job:
    """Many short plans of a chain."""
    number, plans = scaled(2_560_000, scale), chain_plans(10_000, 16)
    prior = MarkovPrior(4, 2).fit(plans)
    tables = prior.log_probs.exp().double().numpy(), prior.next_node.numpy(), int(prior.start_node)
    few = min(10_000, number)
    return Job(
        f"sample {number:,} plans of length 8, Markov-2",
        lambda device: partial(prior.to(device).sample, number, 8),
        (
            Peer("numpy", lambda: partial(bench_peers.numpy_sample, *tables, number, 8), 20),
            Peer(
                "pomegranate",
                partial(bench_packages.pomegranate_sample, plans, 2, few, 8),
                20,
                few / number,
                "pomegranate",
            ),
        ),
    )


def fit_markov(scale: float) -> Job:
    """Counts of many plans."""
    plans = chain_plans(scaled(1_000_000, scale), 32)
    array = plans.numpy()
    return Job(
        f"fit Markov-2 on {len(plans):,} plans of length 32",
        lambda device: lambda: MarkovPrior(4, 2).fit(plans),
        (
            Peer("numpy bincount", lambda: partial(bench_peers.numpy_counts, array, 4, 2), 3),
            Peer("numpy add.at", lambda: partial(bench_peers.numpy_add_at, array, 4, 2), 3),
            Peer("pomegranate", partial(bench_packages.pomegranate_fit, plans, 2), 3, needs="pomegranate"),
        ),
    )


def fit_tree(scale: float) -> Job:
    """Context trees of one long sequence."""
    plan = chain_plans(1, scaled(1_000_000, scale))
    rust = Peer("vlmc (Rust)", partial(bench_packages.vlmc_fit, plan[0].tolist(), 4, 10), 1, needs="vlmc")
    return Job(
        f"fit context trees, depth 10, {plan.numel():,} actions",
        lambda device: lambda: ContextTreePrior(4, 10).fit(plan),
        (rust,),
    )


def evaluate(scale: float) -> Job:
    """Candidate plans tried in a table."""
    starts = scaled(10_000, scale)
    world, generator = gridworld(20, 20, "torus", num_worlds=10), torch.Generator().manual_seed(0)
    state = world.reset(starts, generator)
    plans = UniformPrior(4).sample(starts * 256, 8, generator=generator).view(starts, 256, 8)
    given = world.next_state, world.reward, state, plans
    return Job(
        f"evaluate {starts:,} starts x 256 plans x 8 steps",
        lambda device: partial(world.to(device).rollout, state.to(device), plans.to(device)),
        (
            Peer("plain torch indexing", lambda: partial(bench_peers.torch_rollout, *given), 5),
            Peer("numba, parallel", partial(bench_packages.numba_rollout, *given), 1, needs="numba"),
        ),
    )


def table_1(scale: float) -> Job:
    """The paper's first table without its neural priors."""
    starts = scaled(10_000, scale)
    size = Size(1, starts, starts, 20, 1.0, 4, 8, 256, 0)
    world = gridworld(20, 20, "torus")
    start = world.reset(starts, torch.Generator().manual_seed(0))
    script = partial(bench_peers.numpy_table_1, world.reward[0].numpy(), start.numpy(), 256, 8, 4, (1, 2, 3))
    return Job(
        f"the paper's Table 1, Markov rows, {starts:,} starts",
        lambda device: partial(simulate, Protocol("torus", "uniform", "all"), size, False, lambda what: None),
        (Peer("numpy script", lambda: script, 20),),
    )


def train(scale: float) -> Job:
    """A GRU trained until it is within 1 % of the entropy rate."""
    race = TrainingRace(source(), chain_plans(scaled(100_000, scale), 16))
    return Job(
        f"train GRU-64 to 1 % of the entropy rate, {len(race.plans):,} plans of length 16",
        lambda device: race.ours(),
        (Peer("plain PyTorch, DataLoader", race.theirs, 3),),
    )


def shoot(scale: float) -> Job:
    """Random shooting in a Gymnasium environment; its table is made before, which `setup_seconds` tells."""
    starts, few = scaled(100, scale), scaled(32, scale)
    uniform = UniformPrior(7)
    plans = uniform.sample(256, 16)

    def make(device: torch.device) -> Run:
        world = from_gymnasium(FOUR_ROOMS, seeds=[0], starts="any", progress=False)
        state = world.reset(starts, torch.Generator().manual_seed(0))
        return partial(SamplingPlanner(uniform, 16, 256, objective="return").plan, world, state)

    return Job(
        f"random shooting in MiniGrid FourRooms, {starts} starts x 256 plans x 16 steps",
        make,
        (
            Peer(
                "deepcopy of the environment",
                partial(bench_packages.deep_copies, FOUR_ROOMS, plans[:few]),
                1000,
                few / 256 / starts,
            ),
            Peer(
                "gymnasium vector environment",
                partial(bench_packages.vector_env, FOUR_ROOMS, plans),
                1000,
                1 / starts,
            ),
        ),
        "minigrid",
    )


def decide(scale: float) -> Job:
    """One decision from many starts, against trees with as many model steps, of which an eighth are timed."""
    starts, steps, simulations = scaled(4096, scale), 256 * 8, 256
    world = gridworld(20, 20, "torus", num_worlds=10)
    state = world.reset(starts, torch.Generator().manual_seed(0))
    given = world.next_state, world.reward, state, simulations, 8

    def make(device: torch.device) -> Run:
        prior = MarkovPrior(4, 2).fit(chain_plans(10_000, 16)).to(device)
        return partial(SamplingPlanner(prior, 8, 256, objective="return").plan, world.to(device), state.to(device))

    return Job(
        f"one decision with 256 candidates of 8 steps from {starts:,} starts",
        make,
        tuple(
            Peer(
                f"mctx, {name}",
                partial(bench_packages.mctx_search, *given, gumbel),
                3,
                simulations / steps,
                "mctx",
            )
            for name, gumbel in (("MuZero", False), ("Gumbel MuZero", True))
        ),
    )


JOBS: dict[str, Callable[[float], Job]] = {
    make.__name__: make
    for make in (
        sample_short,
        sample_long,
        sample_gru,
        sample_markov,
        fit_markov,
        fit_tree,
        evaluate,
        table_1,
        train,
        shoot,
        decide,
    )
}
"""By name; each makes its job at a scale: 1 is the size of the goals."""

ON_DEVICES = ("sample_short", "sample_long", "sample_gru", "sample_markov", "evaluate", "decide")
"""Jobs that can be done on other devices than the CPU."""


def chain_plans(number: int, length: int) -> Tensor:
    """Plans `[N, L]` of `source`."""
    return source().sample(number, length, generator=torch.Generator().manual_seed(1))


def source() -> MarkovPrior:
    """A chain of order 2 that reverses its last move seldom."""
    moves = torch.cartesian_prod(*[torch.arange(4)] * 4)
    back = torch.tensor([2, 3, 0, 1])
    onward = (moves[:, 1:] != back[moves[:, :-1]]).all(1)
    return MarkovPrior(4, 2).fit(torch.cat([moves, moves[onward].repeat(5, 1)]))


def scaled(number: int, scale: float) -> int:
    """A share of a number, at least 2."""
    return max(int(number * scale), 2)
