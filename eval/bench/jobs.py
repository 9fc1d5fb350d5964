"""The jobs of `python -m eval bench`: what the library does in each, its peers, and how far ahead it should be."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from itertools import product
from statistics import median
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from eval.bench import peers
from eval.bench.timing import Run, compared, median_seconds, seconds
from neuroprior import (
    ContextTreePrior,
    ExhaustivePlanner,
    GRUPrior,
    MarkovPrior,
    MCTSPlanner,
    Planner,
    Prior,
    SamplingPlanner,
    TabularWorld,
    TransformerPrior,
    UniformPrior,
    World,
    collect,
    from_gymnasium,
    gridworld,
)
from neuroprior.control import DoubleIntegrator, ICEMPlanner, MPPIPlanner, VectorGRU
from neuroprior.control import control as run_control
from neuroprior.priors import CombinedPrior
from neuroprior.priors.ensembles.candidates import DEPTH, OF_EFFORT, ORDERS, networks
from neuroprior.puzzles import AStarPlanner, sliding_tiles
from neuroprior.sampling import sample_in_world
from neuroprior.worlds import GridWorld, cube, from_simulator, maze
from neuroprior.worlds.gymnasium.environment import open_environment

FOUR_ROOMS = "MiniGrid-FourRooms-v0"


@dataclass(frozen=True)
class Peer:
    """What a user would take in place of the library."""

    name: str  # as in the tables
    make: Callable[[], Run]  # prepares it; what it returns is timed
    goal: float  # how many times as long it should take as the library
    share: float = 1.0  # of the job's work that it does, for peers that would take minutes for all of it
    needs: str | None = None  # the package without which it is left out


@dataclass(frozen=True)
class Job:
    """A piece of work that is timed."""

    about: str  # as in the tables
    make: Callable[[torch.device], Run]  # prepares it on a device; what it returns is timed
    peers: tuple[Peer, ...]  # the baselines in the same run, which run on the CPU alone
    needs: str | None = None  # the package without which it is left out


def missing(package: str | None) -> bool:
    """Whether a package is not installed."""
    return package is not None and find_spec(package) is None


@contextmanager
def beside(number: int) -> Iterator[None]:
    """So many other processes that compute without end, as on a machine with other work."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(number)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def against_peers(
    name: str,
    scale: float,
    repetitions: int,
    say: Callable[[str], Any],
    missing: Callable[[str | None], bool] = missing,
    busy: Sequence[int] = (0,),
) -> Iterator[dict[str, Any]]:
    """A row for each peer of a job, beside each number of `busy` processes: how many times as long it takes.

    The two are timed in turn. `say` is called with what is left out, because a package is missing.
    """
    job = JOBS[name](scale)
    if missing(job.needs):
        say(f"{name}: left out, {job.needs} is not installed")
        return
    threads, begin = torch.get_num_threads(), time.perf_counter()
    ours = job.make(torch.device("cpu"))
    setup = time.perf_counter() - begin
    for peer in job.peers:
        if missing(peer.needs):
            say(f"{name}: {peer.name} left out, {peer.needs} is not installed")
            continue
        theirs = peer.make()
        ours(), theirs()  # the first run is slow
        torch.set_num_threads(threads)  # packages change it when they are loaded
        for number in busy:
            with beside(number):
                times = [(seconds(ours), seconds(theirs) / peer.share) for _ in range(repetitions)]
            our_times, other = map(list, zip(*times, strict=True))
            row = {"job": name, "about": job.about, "setup_seconds": setup, "seconds": median(our_times)}
            row |= {"busy": number, "peer": peer.name, "peer_seconds": median(other), "share": peer.share}
            yield row | compared(our_times, other) | {"goal": peer.goal}


def on_device(name: str, device: torch.device, scale: float, repetitions: int) -> Iterator[dict[str, Any]]:
    """The row of a job on an accelerator, and bytes of the device at the peak.

    Seconds there, and on the CPU.
    """
    cuda = device.type == "cuda"
    job = JOBS[name](scale)
    alone = median_seconds(job.make(torch.device("cpu")), repetitions)
    run = job.make(device)

    def finished() -> None:
        run()
        if cuda:  # which has only been given its orders when `run` returns
            torch.cuda.synchronize(device)

    if cuda:
        torch.cuda.reset_peak_memory_stats(device)
    row: dict[str, Any] = {"job": name, "about": job.about}
    row |= {"device": torch.cuda.get_device_name(device) if cuda else device.type}
    row |= {"cpu_seconds": alone, "seconds": median_seconds(finished, repetitions)}
    yield row | {"peak_bytes": torch.cuda.max_memory_allocated(device) if cuda else None}


def sample_short(scale: float) -> Job:
    """Many short plans, which share their beginnings."""
    return _generating_job(scaled(2_560_000, scale), 8, [scaled(size, scale) for size in (1024, 8192, 65_536)], 500)


def sample_long(scale: float) -> Job:
    """Long plans, of which hardly two begin alike."""
    return _generating_job(scaled(8192, scale), 64, [scaled(size, scale) for size in (512, 2048, 8192)], 10)


def _generating_job(number: int, length: int, batches: list[int], goal: float) -> Job:
    """A transformer samples, against one of another package in batches of several sizes."""

    def peer(batch: int) -> Peer:
        make = partial(peers.transformers_generate, 4, length, batch)
        return Peer(f"transformers generate, {batch:,} at once", make, goal, batch / number, "transformers")

    return Job(
        f"sample {number:,} plans of length {length}, transformer",
        lambda device: partial(TransformerPrior(4).to(device).sample, number, length),
        tuple(map(peer, sorted(set(batches)))),
    )


def sample_gru(scale: float) -> Job:
    """Long plans of a small GRU."""
    return _sample_gru("GRU", 64, 1, scale)


def sample_gru_two(scale: float) -> Job:
    """Long plans of a GRU as `fit` makes it for long plans."""
    return _sample_gru("GRU of two layers of 128", 128, 2, scale)


def _sample_gru(name: str, size: int, num_layers: int, scale: float) -> Job:
    number = scaled(8192, scale)
    return Job(
        f"sample {number:,} plans of length 64, {name}",
        lambda device: partial(GRUPrior(4, size, num_layers, lags=1).to(device).sample, number, 64),
        (Peer("plain PyTorch", lambda: partial(peers.PlainGRU(4, size, num_layers).eval().sample, number, 64), 3),),
    )


def sample_few(scale: float, make: type[GRUPrior] | type[TransformerPrior] = GRUPrior) -> Job:
    """The candidates of one decision."""
    number, name = scaled(256, scale), make.__name__.removesuffix("Prior")
    return Job(
        f"sample {number:,} plans of length 20, {name}",
        lambda device: partial(make(4).to(device).sample, number, 20),
        (),
    )


def sample_beside(scale: float) -> Job:
    """Many plans from few starts, of a GRU that is given each observation while a world is stepped along."""
    world = maze(egocentric=True, view=2, num_layouts=20)
    state = world.reset(scaled(16, scale), torch.Generator().manual_seed(0))
    prior = GRUPrior(3, lags=1, context_size=world.observe(state).shape[1])
    return _sampling_beside("a maze", world, state, prior, 2048, 24)


def sample_beside_cube(scale: float) -> Job:
    """Few plans from many starts, of a GRU that has learned, as planners sample: most of them begin alike."""
    world, generator = cube(scramble=4), torch.Generator().manual_seed(0)
    plans = collect(ExhaustivePlanner(4), world, 2000, context="step", min_score=0, generator=generator)
    state = world.reset(scaled(2000, scale), generator)
    prior = GRUPrior(9, lags=1, context_size=world.observe(state).shape[1])
    prior.fit(plans, generator=generator, max_steps=200, progress=False)
    return _sampling_beside("a cube", world, state, prior, 64, 8)


def _sampling_beside(name: str, world: World, state: Tensor, prior: Prior, number: int, length: int) -> Job:
    plain = peers.ObservingGRU(prior.num_actions, world.observe(state).shape[1]).eval()
    return Job(
        f"sample {number:,} plans of length {length} beside {name} from {len(state):,} starts, GRU",
        lambda device: partial(sample_in_world, prior.to(device), world.to(device), state.to(device), number, length),
        (Peer("plain PyTorch", lambda: partial(plain.sample_in_world, world, state, number, length), 3),),
    )


TRAINED = 12
"""Actions of the plans after which longer ones are sampled."""


def horizon(make: type[GRUPrior] | type[TransformerPrior], times: int, scale: float) -> Job:
    """Plans so many times as long as those that a network was trained on; its peer are plans of that length."""
    number = scaled(2048, scale)
    prior = make(4, window=TRAINED - 1)
    baseline = partial(prior.sample, number, TRAINED, method="ancestral")
    name = prior.__class__.__name__.removesuffix("Prior")
    return Job(
        f"sample {number:,} plans of length {times * TRAINED}, {name} trained on {TRAINED}",
        lambda device: partial(prior.to(device).sample, number, times * TRAINED, method="ancestral"),
        (Peer(f"{times} times plans of length {TRAINED}", lambda: baseline, round(1 / 1.3, 2), 1 / times),),
    )


def sample_combined(scale: float) -> Job:
    """Many short plans of a combined prior that keeps a chain, a context tree and a network; its peer is the dearest
    of these.
    """
    number, plans = scaled(2_560_000, scale), chain_plans(10_000, 16)
    parts = [MarkovPrior(4, 2).fit(plans), ContextTreePrior(4, DEPTH).fit(plans), GRUPrior(4, 64, lags=1)]
    prior = CombinedPrior(4, parts)

    def dearest() -> Run:
        runs = [partial(expert.sample, number, 8) for expert in parts]
        for run in runs:
            run()  # the first run is slow
        return max(runs, key=seconds)

    return Job(
        f"sample {number:,} plans of length 8, combined prior of three",
        lambda device: partial(prior.to(device).sample, number, 8),
        (Peer("its dearest part", dearest, round(1 / 3, 2)),),
    )


def fit_combined(scale: float) -> Job:
    """The combined prior; its peer fits what it combines one after the other, each as it is fitted alone."""
    plans, how = chain_plans(scaled(10_000, scale), 16), {"max_steps": 200, "progress": False}

    def parts() -> None:
        generator = torch.Generator().manual_seed(0)
        for order in ORDERS:
            MarkovPrior(4, order).fit(plans)
        ContextTreePrior(4, DEPTH).fit(plans)
        for prior in networks(4, {}, "standard", 0).values():
            prior.fit(plans, generator=generator, **how)

    return Job(
        f"fit the combined prior on {len(plans):,} plans of length 16, 200 steps",
        lambda device: (
            lambda: CombinedPrior(4, networks=OF_EFFORT["standard"]).fit(
                plans, generator=torch.Generator().manual_seed(0), **how
            )
        ),
        (Peer("its parts, one after the other", lambda: parts, round(1 / 1.5, 2)),),
    )


def sample_markov(scale: float) -> Job:
    """Many short plans of a chain."""
    number, plans = scaled(2_560_000, scale), chain_plans(10_000, 16)
    prior = MarkovPrior(4, 2).fit(plans)
    tables = prior.log_probs.exp().double().numpy(), prior.next_node.numpy(), int(prior.start_node)
    few = min(10_000, number)
    pomegranate = partial(peers.pomegranate_sample, plans, 2, few, 8)
    return Job(
        f"sample {number:,} plans of length 8, Markov-2",
        lambda device: partial(prior.to(device).sample, number, 8),
        (
            Peer("numpy", lambda: partial(peers.numpy_sample, *tables, number, 8, np.random.default_rng(0)), 20),
            Peer("pomegranate", pomegranate, 20, few / number, "pomegranate"),
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
            Peer("numpy bincount", lambda: partial(peers.numpy_counts, array, 4, 2), 3),
            Peer("numpy add.at", lambda: partial(peers.numpy_add_at, array, 4, 2), 3),
            Peer("pomegranate", partial(peers.pomegranate_fit, plans, 2), 3, needs="pomegranate"),
        ),
    )


def fit_tree(scale: float) -> Job:
    """Context trees of one long sequence."""
    plan = chain_plans(1, scaled(1_000_000, scale))
    return Job(
        f"fit context trees, depth 10, {plan.numel():,} actions",
        lambda device: lambda: ContextTreePrior(4, 10).fit(plan),
        (Peer("vlmc (Rust)", partial(peers.vlmc_fit, plan[0].tolist(), 4, 10), 1, needs="vlmc"),),
    )


def evaluate(scale: float) -> Job:
    """Candidate plans tried in a table."""
    starts = scaled(10_000, scale)
    world = gridworld(20, 20, "torus", num_worlds=10)
    generator = torch.Generator().manual_seed(0)
    state = world.reset(starts, generator)
    plans = UniformPrior(4).sample(starts * 256, 8, generator=generator).view(starts, 256, 8)
    arguments = world.next_state, world.reward, state, plans
    return Job(
        f"evaluate {starts:,} starts x 256 plans x 8 steps",
        lambda device: partial(world.to(device).rollout, state.to(device), plans.to(device)),
        (
            Peer("plain torch indexing", lambda: partial(peers.torch_rollout, *arguments), 5),
            Peer("numba, parallel", partial(peers.numba_rollout, *arguments), 1),
        ),
    )


def table_1(scale: float) -> Job:
    """The paper's first table without its neural priors."""
    starts, size = scaled(10_000, scale), (256, 8, 4, (1, 2, 3))
    world = gridworld(20, 20, "torus")
    start = world.reset(starts, torch.Generator().manual_seed(0))
    script = partial(peers.numpy_table_1, world.reward[0].numpy(), start.numpy(), *size)
    return Job(
        f"the paper's Table 1, Markov rows, {starts:,} starts",
        lambda device: partial(our_table_1, world, start, *size),
        (Peer("numpy script", lambda: script, 20),),
    )


def our_table_1(
    world: GridWorld, start: Tensor, num_plans: int, length: int, depth: int, orders: tuple[int, ...]
) -> dict[str, Tensor]:
    """What `peers.numpy_table_1` does, with the library: scores `[n]` by planner."""
    generator, deterministic = torch.Generator().manual_seed(0), ExhaustivePlanner(depth)
    learned = deterministic.plan(world, world.reset(len(start), generator), generator).plan
    priors: dict[str, Prior] = {"random": UniformPrior(4)}
    priors |= {f"markov-{order}": MarkovPrior(4, order).fit(learned) for order in orders}
    planners: dict[str, Planner] = {"deterministic": deterministic}
    planners |= {name: SamplingPlanner(prior, length, num_plans) for name, prior in priors.items()}
    return {name: planner.plan(world, start, generator).score for name, planner in planners.items()}


def train(scale: float, within: float = 0.01, goal: float = 3) -> Job:
    """A GRU of 64 units, trained until it is above the entropy rate of the plans' source by at most a share `within`.

    Both sides choose their batch size, learning rate and number of steps; what is timed is the training alone, without
    the search for its settings.
    """
    chain, plans = source(), chain_plans(scaled(100_000, scale), 16)
    held_out = chain.sample(10_000, plans.shape[1], generator=torch.Generator().manual_seed(2))

    def ours(batch_size: int, learning_rate: float, steps: int) -> nn.Module:
        how = {"batch_size": batch_size, "learning_rate": learning_rate, "max_steps": steps}
        prior, generator = GRUPrior(4, lags=1), torch.Generator().manual_seed(0)
        return prior.fit(plans, generator=generator, progress=False, **how)

    def close(model: nn.Module) -> bool:
        return excess(model, chain, held_out) <= 1 + within

    return Job(
        f"train GRU-64 to {100 * within:g} % of the entropy rate, {len(plans):,} plans of length 16",
        lambda device: quickest(ours, close),
        (Peer("plain PyTorch, DataLoader", lambda: quickest(partial(peers.plain_training, plans, 4), close), goal),),
    )


@torch.no_grad()
def excess(model: nn.Module, source: MarkovPrior, held_out: Tensor) -> float:
    """Nats a plan that a model takes for plans of a source, divided by what the source itself takes."""
    nats = nn.functional.cross_entropy(model(held_out).flatten(0, 1), held_out.flatten().long())
    return float(nats) * held_out.shape[1] / float(-source.log_prob(held_out).mean())


def quickest(
    train: Callable[[int, float, int], nn.Module],
    close: Callable[[nn.Module], bool],
    clock: Callable[[], float] = time.perf_counter,
) -> Run:
    """The training, by batch size, learning rate and number of steps, that comes close enough in the least time."""
    settings, numbers = list(product((64, 256, 1024), (1e-3, 3e-3, 1e-2))), (25, 50, 100, 200, 400, 800)
    train(*settings[0], numbers[0])  # the first run is slow
    enough: dict[tuple[int, float, int], float] = {}
    for setting in settings:
        for steps in numbers:
            begin = clock()
            model = train(*setting, steps)
            taken = clock() - begin
            if close(model):
                enough[*setting, steps] = taken
            if enough and taken >= min(enough.values()):
                break
    if not enough:
        raise ValueError(f"train: no training of {numbers[-1]} steps came close enough to the entropy rate")
    return partial(train, *min(enough, key=lambda how: enough[how]))


def shoot(scale: float) -> Job:
    """Random shooting in a Gymnasium environment; its table is made before, which takes `setup_seconds`."""
    starts, few = scaled(100, scale), scaled(32, scale)
    uniform = UniformPrior(7)
    plans = uniform.sample(256, 16)

    def make(device: torch.device) -> Run:
        world = from_gymnasium(FOUR_ROOMS, seeds=[0], starts="any", progress=False)
        state = world.reset(starts, torch.Generator().manual_seed(0))
        return partial(SamplingPlanner(uniform, 16, 256, objective="return").plan, world, state)

    copies, envs = partial(peers.deep_copies, FOUR_ROOMS, plans[:few]), partial(peers.vector_env, FOUR_ROOMS, plans)
    return Job(
        f"random shooting in MiniGrid FourRooms, {starts} starts x 256 plans x 16 steps",
        make,
        (
            Peer("deepcopy of the environment", copies, 1000, few / 256 / starts),
            Peer("gymnasium vector environment", envs, 1000, 1 / starts),
        ),
        "minigrid",
    )


def step(kind: str, scale: float) -> Job:
    """Plans tried in copies of a simulator, against a bare loop of copies and steps."""
    name = {"cart": "CartPole-v1", "minigrid": FOUR_ROOMS}.get(kind)

    def simulator() -> Any:
        if name is None:
            return peers.Slider()
        env = open_environment(name, {})[0]
        env.reset(seed=0)
        return env

    number = 3 if name is None else int(simulator().action_space.n)
    plans = UniformPrior(number).sample(scaled(256, scale), 20, generator=torch.Generator().manual_seed(0))

    def make(device: torch.device) -> Run:
        world = from_simulator(simulator(), number)
        return partial(world.rollout, world.reset(1), plans[None])

    peer = Peer("a bare loop of deepcopy and step", lambda: peers.bare_loop(simulator(), plans), 0.5)
    return Job(
        f"{len(plans)} plans of 20 steps in copies of {name or 'a simulator of 2 µs'}", make, (peer,), "minigrid"
    )


def search_tiles(scale: float) -> Job:
    """A*, which no solution stops, so that expansions are compared."""
    world, most = sliding_tiles(shape=(5, 5), scramble=2000), scaled(10_000, scale)
    boards = world.reset(100, torch.Generator().manual_seed(0))
    few = boards[:5].flatten(1)
    return Job(
        f"A*, {most:,} expansions of each of 100 24-puzzles",
        lambda device: partial(AStarPlanner(world.lower_bound, max_nodes=most).search, world, boards),
        (Peer("plain Python, heapq", partial(peers.python_a_star, few, 5, most), 20, len(few) / len(boards)),),
    )


def control(scale: float) -> Job:
    """One decision over vectors from several starts."""
    world, length, plans = DoubleIntegrator(), 30, scaled(1000, scale)
    state = world.reset(16, torch.Generator().manual_seed(0))
    plain = partial(peers.plain_mppi, world, state, length, plans, 0.5)
    return Job(
        f"MPPI, {plans:,} plans of {length} steps from each of 16 starts, double integrator",
        lambda device: partial(MPPIPlanner(length, plans).plan, world, state, torch.Generator().manual_seed(0)),
        (Peer("plain PyTorch, one start after the other", lambda: plain, 1),),
    )


def decide(scale: float) -> Job:
    """One decision from many starts."""
    starts = scaled(4096, scale)
    world = gridworld(20, 20, "torus", num_worlds=10)
    state = world.reset(starts, torch.Generator().manual_seed(0))

    def make(device: torch.device) -> Run:
        prior = MarkovPrior(4, 2).fit(chain_plans(10_000, 16)).to(device)
        return partial(SamplingPlanner(prior, 8, 256, objective="return").plan, world.to(device), state.to(device))

    return Job(f"one decision with 256 candidates of 8 steps from {starts:,} starts", make, ())


def decide_vectors(scale: float) -> Job:
    """Decisions over vectors from many starts, with candidates of a network: one, and then those that follow it."""
    starts = scaled(256, scale)

    def make(device: torch.device) -> Run:
        world = DoubleIntegrator().to(device)
        prior = VectorGRU(world.action_low, world.action_high, width=64).to(device)
        planner = ICEMPlanner(20, 32, prior=prior, prior_share=0.5)
        return partial(run_control, planner, world, world.reset(starts, torch.Generator().manual_seed(0)), 5)

    return Job(f"5 decisions of iCEM, 32 candidates of 20 vectors from {starts:,} starts, half of a GRU", make, ())


def trees(policy: str, starts: int, scale: float) -> Job:
    """Tree search with the same policy and as many simulations, each of which is followed to the end of its plan."""
    world = gridworld(20, 20, "torus", num_worlds=10)
    state = world.reset(starts, torch.Generator().manual_seed(0))
    prior: Prior = UniformPrior(4)
    if policy == "Markov-2":
        prior = source()
    elif policy == "GRU-64":
        prior = GRUPrior(4, 64, lags=1)
    planner = MCTSPlanner(prior, 8, scaled(64, scale), objective="return")

    def decision() -> Any:
        return planner.plan(world, state, torch.Generator().manual_seed(0))

    def mctx() -> Run:
        return peers.mctx_search(world, state, prior, simulations(planner, world, state), planner.length)

    peer = Peer("mctx", mctx, 1.5 if policy == "GRU-64" else 3, needs="mctx")
    about = f"tree search of 64 x 8 steps, {policy}, from {starts:,} start" + "s" * (starts > 1)
    return Job(about, lambda device: decision, (peer,))


@torch.no_grad()
def simulations(planner: MCTSPlanner, world: TabularWorld, state: Tensor) -> int:
    """How many plans the planner simulates from each start, on average."""
    from neuroprior.planners.compiled_mcts import search_all

    done = search_all(planner, world, state, torch.Generator().manual_seed(0))[3]
    return round(float(done.sum(1).double().mean()))


JOBS: dict[str, Callable[[float], Job]] = {
    make.__name__: make
    for make in (
        *(sample_short, sample_long, sample_few, sample_gru, sample_gru_two, sample_beside, sample_beside_cube),
        *(sample_combined, fit_combined, sample_markov, fit_markov, fit_tree),
        *(evaluate, table_1, train, shoot, decide, decide_vectors, search_tiles, control),
    )
}
"""By name; each makes its job at a scale: 1 is the size of the goals."""

JOBS |= {
    f"trees_{policy.split('-')[0].lower()}_{starts}": partial(trees, policy, starts)
    for policy in ("uniform", "Markov-2", "GRU-64")
    for starts in (1, 64, 1024)
}

JOBS |= {f"step_{kind}": partial(step, kind) for kind in ("slider", "cart", "minigrid")}

JOBS["train_closer"] = partial(train, within=0.002, goal=1)
JOBS["sample_few_transformer"] = partial(sample_few, make=TransformerPrior)

JOBS |= {
    f"horizon_{name}_{times}": partial(horizon, make, times)
    for name, make in (("gru", GRUPrior), ("transformer", TransformerPrior))
    for times in (2, 16)
}

ON_DEVICES = (
    *("sample_short", "sample_long", "sample_few", "sample_few_transformer", "sample_gru", "sample_gru_two"),
    *("sample_markov", "sample_combined", "sample_beside", "sample_beside_cube"),
    *("horizon_gru_16", "horizon_transformer_2", "evaluate", "decide", "decide_vectors"),
)
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
