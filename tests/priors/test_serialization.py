"""Model folders: what is saved is read back exactly; what is damaged or foreign is named, and never executed."""

import json
import math
import pickle
import time
from collections import Counter
from copy import deepcopy
from functools import partial, reduce
from random import Random
from threading import Thread

import pytest
import torch
from safetensors.torch import load as read_tensors

from neuroprior import GRUPrior, MarkovPrior, TransformerPrior, UniformPrior, load, save
from neuroprior.priors import Prior, StackedPrior, serialization
from neuroprior.priors.saved import SavedModule
from tests.support.saved import SAVED, content_of, rewrite
from tests.support.sources import refuses, says, seeded

A = 3


@pytest.mark.parametrize("name", SAVED)
def test_round_trip(name, tmp_path):
    """What it predicts then is compared in `test_contracts.py`."""
    prior, folder = SAVED[name](), tmp_path / "new" / "model"
    assert save(prior, folder) == folder
    assert sorted(path.name for path in folder.iterdir()) == ["config.json", "model.safetensors"]
    again = load(folder, kind=SavedModule)
    assert type(again) is type(prior)
    assert (again.config, again.learned) == (prior.config, prior.learned)
    assert not again.training
    for key, value in prior.state_dict().items():
        assert value.equal(again.state_dict()[key]), key


@pytest.mark.parametrize(
    "made",
    [
        lambda: GRUPrior(A, seed=7),
        lambda: GRUPrior(A, 8, lags=2),
        lambda: TransformerPrior(A, 16, seed=7),
        lambda: StackedPrior(A, 8, seed=7),
        lambda: StackedPrior(A, 8, num_layers=1),
    ],
)
def test_a_network_that_is_saved_before_it_learns_learns_the_same(made, tmp_path):
    """Sizes that `fit` chooses are not fixed by saving, and the seed of the weights is kept."""
    first, plans = made(), torch.randint(A, (40, 4), generator=seeded(0))
    again = load(save(first, tmp_path))
    for prior in (first, again):
        prior.fit(plans, max_steps=3, progress=False, generator=seeded(1))
    assert repr(again) == repr(first)
    for name, value in first.state_dict().items():
        assert value.equal(again.state_dict()[name]), name
    assert repr(load(save(first, tmp_path))) == repr(first)


@pytest.mark.parametrize("kind", [GRUPrior, TransformerPrior])
def test_priors_trained_in_windows_read_as_before(kind, tmp_path):
    prior = kind(A)
    prior.set_training_window(4)
    plans = torch.randint(A, (10, 30), generator=seeded(0))
    with torch.no_grad():
        assert torch.equal(load(save(prior, tmp_path)).log_prob(plans), prior.log_prob(plans))


@pytest.fixture(params=["markov", "gru"])
def folder(request, tmp_path):
    prior = GRUPrior(A, hidden_size=8)
    if request.param == "markov":
        prior = MarkovPrior(A, 2).fit(torch.randint(A, (40, 4), generator=seeded(0)))
    return save(prior, tmp_path / "model")


def refused(folder, *words, error=ValueError):
    with refuses(*words, error=error):
        load(folder)


def test_saving_over_a_folder(folder):
    plans = torch.randint(A, (20, 5), generator=seeded(1))
    for prior in (MarkovPrior(A, 3).fit(plans), UniformPrior(A), GRUPrior(A, 8, seed=7), MarkovPrior(A, 1)):
        save(prior, folder)
        again = load(folder)
        assert type(again) is type(prior)
        torch.testing.assert_close(again.log_prob(plans), prior.log_prob(plans))
    assert len(list(folder.iterdir())) == 2


@pytest.mark.parametrize("name", ["model.safetensors", "config.json"])
def test_a_save_that_is_cut_off_leaves_a_whole_model(folder, name, monkeypatch):
    """The disk is full before either of the two files is written."""
    before, write = load(folder), serialization.write_whole

    def full(path, content):
        if name == path.name:
            raise OSError(28, "No space left on device", str(path))
        write(path, content)

    with monkeypatch.context() as patched:
        patched.setattr(serialization, "write_whole", full)
        with pytest.raises(OSError, match="No space"):
            save(MarkovPrior(A, 3), folder)
    plans = torch.randint(A, (20, 5), generator=seeded(1))
    due = before if name == "model.safetensors" else MarkovPrior(A, 3)
    assert torch.equal(load(folder).log_prob(plans), due.log_prob(plans))


def test_missing(folder):
    """Without `config.json` the model is whole: whoever saves it may be about to write the copy."""
    refused(folder / "nowhere", "nowhere", error=FileNotFoundError)
    (folder / "config.json").unlink()
    assert load(folder).num_actions == A
    (folder / "model.safetensors").unlink()
    refused(folder, "model.safetensors", error=FileNotFoundError)


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_cut_off_and_one_byte_changed(folder, name):
    data = (folder / name).read_bytes()
    damaged = [data[: int(len(data) * share)] for share in (0, 0.1, 0.5, 0.99)]
    for at in (0, 9, 60, len(data) // 3, len(data) // 2, len(data) - 3):
        damaged.append(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    for content in damaged:
        (folder / name).write_bytes(content)
        refused(folder, name)


@pytest.mark.parametrize(
    "content", [b"\x80\x04\xff\xfe", b"[]", b"{}", b'"x"', b"null", b'{"format": "other"}', b"not json", b"[" * 10**6]
)
def test_foreign_config(folder, content):
    (folder / "config.json").write_bytes(content)
    refused(folder, "config.json")


def mixture(*experts):
    return {"prior": "MixturePrior", "config": {"num_actions": A, "experts": list(experts)}}


UNIFORM = {"prior": "UniformPrior", "config": {"num_actions": A}}
DEEP = reduce(lambda inner, _: mixture(inner), range(60), UNIFORM)["config"]
BUSHY = reduce(lambda inner, _: mixture(inner, inner), range(14), UNIFORM)["config"]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"version": 1}, "version 1"),
        ({"version": "2"}, "version"),
        ({"format": "another model"}, "format"),
        ({"prior": "os.system"}, "os.system"),
        ({"prior": "NeuralPrior"}, ""),
        ({"prior": {"a": 1}}, ""),
        ({"prior": "UniformPrior"}, ""),
        ({"config": []}, "config"),
        ({"config": {"num_actions": 4}}, ""),
        ({"config": {"num_actions": 3, "unheard": 1}}, "unheard"),
        ({"config": {"num_actions": 3, "order": 900_000_000}}, ""),
        ({"config": {"num_actions": 3, "num_layers": 10**6}}, ""),
        ({"config": {"num_actions": 2**70}}, "at most 9223372036854775807"),
        ({"config": {"num_actions": 3, "smoothing": math.inf}}, "finite"),
        ({"prior": "MixturePrior", "config": DEEP}, "nested at most"),
        ({"prior": "MixturePrior", "config": BUSHY}, "at most 1000 priors"),
    ],
)
def test_foreign_entries(folder, change, word):
    rewrite(folder, content_of(folder) | change)
    begin = time.monotonic()
    refused(folder, str(folder / "model.safetensors"), word)
    assert time.monotonic() - begin < 2


@pytest.mark.parametrize("key", ["format", "version", "prior", "config", "learned", "weights", "sha256"])
def test_missing_entries(folder, key):
    content = content_of(folder)
    del content[key]
    (folder / "config.json").write_text(json.dumps(content))
    refused(folder, "config.json", "checksum" if key == "sha256" else key)


class Poison:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
@pytest.mark.parametrize("how", ["pickle", "torch.save"])
def test_nothing_is_executed(folder, how, name):
    touched = folder / "touched"
    if how == "torch.save":
        torch.save({"x": Poison(touched)}, folder / name)
    else:
        (folder / name).write_bytes(pickle.dumps(Poison(touched)))
    refused(folder, name)
    assert not touched.exists()


@pytest.mark.parametrize("name", SAVED)
def test_a_mutated_model_loads_as_it_says_or_is_refused(name, tmp_path):
    """Whatever changes, with checksums that belong to it: a value of the configuration, or a tensor."""
    folder, random = save(SAVED[name](), tmp_path / "model"), Random(name)
    before = content_of(folder), read_tensors((folder / "model.safetensors").read_bytes())
    for _ in range(40):
        content, tensors = deepcopy(before)
        mutate(content, tensors, random)
        rewrite(folder, content, tensors)
        prior, refusal = None, None
        begin = time.monotonic()
        try:
            prior = load(folder, kind=SavedModule)
        except ValueError as error:
            refusal = error
        assert time.monotonic() - begin < 2
        if prior is None:
            assert says(refusal, str(folder / "model.safetensors"))
            continue
        assert json.loads(json.dumps([prior.config, prior.learned])) == [content["config"], content["learned"]]
        for key, value in prior.state_dict().items():
            assert torch.equal(value, tensors[key])
        if isinstance(prior, Prior) and not prior.takes_context:
            assert prior.sample(2, 3, generator=seeded(0)).shape == (2, 3)
    rewrite(folder, *before)
    assert load(folder, kind=SavedModule).config == before[0]["config"]


def mutate(content, tensors, random):
    """Change a value of the configuration, or a tensor."""
    places = [(tensors, key) for key in tensors]
    todo = [content["config"], content["learned"]]
    while todo:
        inside = todo.pop()
        for key in range(len(inside)) if isinstance(inside, list) else list(inside):
            places.append((inside, key))
            todo += [inside[key]] if isinstance(inside[key], list | dict) else []
    where, key = random.choice(places)
    if where is not tensors:
        old = where[key]
        numbers = [old + 1, -old, old * 10**6] if isinstance(old, int | float) else []
        where[key] = random.choice([None, True, -1, 0, 2, 0.5, "x", [], {}, [old], 2**70, math.inf, math.nan, *numbers])
        return
    value = tensors[key]
    kinds = [value.to(random.choice([torch.float64, torch.float16, torch.int64, torch.int8, torch.bool]))]
    kinds += [value[None], value.flatten()[:-1], torch.cat([value.flatten()] * 2)]
    if value.numel():
        other = value.clone()
        other.view(-1)[random.randrange(value.numel())] = random.choice([3, -1, 0, 2**30])
        kinds += [other] * 3
        if value.is_floating_point():
            kinds += [torch.full_like(value, number) for number in (math.inf, -math.inf, math.nan)]
    tensors[key] = random.choice(kinds).contiguous()


def test_a_class_of_ones_own_is_found_by_name(tmp_path):
    class OwnPrior(UniformPrior):
        pass

    save(OwnPrior(A), tmp_path)
    assert type(load(tmp_path)) is OwnPrior
    del SavedModule.known._entries["OwnPrior"]
    refused(tmp_path, "OwnPrior", "import")


@pytest.mark.parametrize("make", [lambda: MarkovPrior(3, 2), lambda: GRUPrior(3, hidden_size=8)])
def test_a_configuration_cannot_ask_for_more_than_the_file_holds(make, tmp_path):
    """Nothing of that size is made: 10**12 numbers would not fit into any memory here."""
    folder = save(make(), tmp_path / "prior")
    content = content_of(folder)
    content["config"]["num_actions"] = 10**12
    rewrite(folder, content)
    refused(folder, "would need at least")


def test_beside_one_another_writers_and_a_reader_have_whole_models(tmp_path):
    """Two savers and a reader, for a second; in the end both files are of the same model, and nothing else is left."""
    folder, ends, errors = tmp_path / "model", time.monotonic() + 1, []
    made = [MarkovPrior(A, 1).fit(torch.randint(A, (20, 5), generator=seeded(0))), UniformPrior(A)]
    due, counts = {type(prior): serialization.model_bytes(prior) for prior in made}, Counter()
    save(made[0], folder)

    def work(step):
        try:
            while time.monotonic() < ends:
                step()
        except Exception as error:
            errors.append(error)

    def read():
        prior = load(folder)
        assert serialization.model_bytes(prior) == due[type(prior)]
        counts[type(prior)] += 1

    steps = [*(partial(save, prior, folder) for prior in made), read]
    threads = [Thread(target=work, args=[step]) for step in steps]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert min(counts[type(prior)] for prior in made) > 0
    assert {path.name for path in folder.iterdir()} == {"model.safetensors", "config.json"}
    assert content_of(folder) == serialization._content_of((folder / "model.safetensors").read_bytes())


@pytest.mark.parametrize("folder", ["", " ", 3, None])
def test_a_folder_has_a_name(folder, tmp_path, monkeypatch):
    """Without one a prior would be written among the files of the present folder."""
    monkeypatch.chdir(tmp_path)
    for call in (lambda: save(MarkovPrior(2, 0), folder), lambda: load(folder)):
        with pytest.raises(ValueError, match="`folder` must be the name of a folder, got"):
            call()
    assert not list(tmp_path.iterdir())
