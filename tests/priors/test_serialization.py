"""Model folders: what is saved is read back exactly; what is damaged or foreign is named, and never executed."""

import hashlib
import json
import pickle
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from neuroprior import GRUPrior, MarkovPrior, Plans, TransformerPrior, UniformPrior, load, save
from neuroprior.priors import StackedPrior
from neuroprior.priors.saved import SavedModule
from tests.support.sources import refuses, says, seeded

A = 3
INDEX, FEATURES = {"num_contexts": 4}, {"context_size": 2}
PRIORS = [
    (UniformPrior, {}),
    *((MarkovPrior, {"order": k, "initial": i, "smoothing": 0.3}) for k in (0, 1, 3) for i in ("joint", "lower")),
    (MarkovPrior, {"order": 2} | INDEX),
    *((GRUPrior, {"hidden_size": 8, "num_layers": 2} | current) for current in ({}, {"window": 2}, INDEX, FEATURES)),
    *((TransformerPrior, {"width": 8, "num_heads": 2} | current) for current in ({}, {"window": 2}, INDEX, FEATURES)),
]


def draw_context(arguments, per, num=40, length=4):
    shape = (num,) if per == "plan" else (num, length)
    if "num_contexts" in arguments:
        return torch.randint(4, shape, generator=seeded(1))
    return torch.rand(*shape, 2, generator=seeded(1)) if "context_size" in arguments else None


@pytest.mark.parametrize("fitted", [None, "plan", "step"])
@pytest.mark.parametrize(("kind", "arguments"), PRIORS)
def test_round_trip(kind, arguments, fitted, tmp_path):
    prior = kind(A, **arguments)
    plans = torch.randint(A, (40, 4), generator=seeded(0))
    context = draw_context(arguments, fitted or "step")
    if fitted:
        quick = (
            {"generator": seeded(2), "max_steps": 5, "progress": False} if kind in (GRUPrior, TransformerPrior) else {}
        )
        prior.fit(Plans(plans, A, context=context), **quick)
    folder = tmp_path / "new" / "model"
    assert save(prior, folder) == folder
    assert sorted(path.name for path in folder.iterdir()) == ["config.json", "model.safetensors"]
    again = load(folder)
    assert type(again) is kind
    assert again.config == prior.config
    assert again.context_per == prior.context_per
    assert not again.training
    longer = torch.randint(A, (40, 7), generator=seeded(3))
    context = draw_context(arguments, "step", length=7)
    with torch.no_grad():
        longer = Plans(longer, A, context=context)
        assert torch.equal(again.log_prob(longer), prior.eval().log_prob(longer))


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


def edit(folder, **change):
    config = json.loads((folder / "config.json").read_text()) | change
    (folder / "config.json").write_text(json.dumps(config))


def weights(folder, data):
    """Replace the weights by `data`, with the checksum that belongs to it."""
    (folder / "model.safetensors").write_bytes(data)
    edit(folder, sha256=hashlib.sha256(data).hexdigest())


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
def test_a_save_that_is_cut_off_leaves_what_was_there(folder, name, monkeypatch):
    """The disk is full before either of the two files is written."""
    before, write = load(folder), Path.write_bytes

    def full(path, content):
        if name in path.name:
            write(path, content[:10])
            raise OSError(28, "No space left on device", str(path))
        return write(path, content)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", full)
        with pytest.raises(OSError, match="No space"):
            save(MarkovPrior(A, 3), folder)
    plans = torch.randint(A, (20, 5), generator=seeded(1))
    assert torch.equal(load(folder).log_prob(plans), before.log_prob(plans))


def test_missing(folder):
    refused(folder / "nowhere", "nowhere", error=FileNotFoundError)
    (folder / "model.safetensors").unlink()
    refused(folder, "model.safetensors", error=FileNotFoundError)
    save(UniformPrior(A), folder)
    (folder / "config.json").unlink()
    refused(folder, "config.json", error=FileNotFoundError)


@pytest.mark.parametrize("share", [0, 0.1, 0.5, 0.99])
@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
@pytest.mark.parametrize("checked", [False, True])
def test_truncated(folder, name, share, checked):
    data = (folder / name).read_bytes()
    data = data[: int(len(data) * share)]
    if checked and name == "model.safetensors":
        weights(folder, data)
        refused(folder, "model")
    else:
        (folder / name).write_bytes(data)
        refused(folder, name)


@pytest.mark.parametrize("at", [0, 9, 60, -1])
def test_one_byte_changed(folder, at):
    data = bytearray((folder / "model.safetensors").read_bytes())
    data[at] ^= 1
    (folder / "model.safetensors").write_bytes(data)
    refused(folder, "model.safetensors")


@pytest.mark.parametrize(
    "content", [b"\x80\x04\xff\xfe", b"[]", b"{}", b'"x"', b"null", b'{"format": "other"}', b"not json"]
)
def test_foreign_config(folder, content):
    (folder / "config.json").write_bytes(content)
    refused(folder, "config.json")


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"version": 2}, "version 2"),
        ({"version": None}, "version"),
        ({"version": "1"}, "version"),
        ({"format": "another model"}, "format"),
        ({"prior": "os.system"}, "os.system"),
        ({"prior": "NeuralPrior"}, ""),
        ({"prior": None}, ""),
        ({"prior": []}, ""),
        ({"prior": {"a": 1}}, ""),
        ({"prior": "UniformPrior"}, ""),
        ({"prior": "TransformerPrior"}, ""),
        ({"config": None}, "config"),
        ({"config": []}, "config"),
        ({"config": {}}, ""),
        ({"config": {"num_actions": "3"}}, ""),
        ({"config": {"num_actions": 4}}, ""),
        ({"config": {"num_actions": 3, "unheard": 1}}, "unheard"),
        ({"config": {"num_actions": 3, "order": -1}}, ""),
        ({"sha256": "0"}, "model.safetensors"),
        ({"sha256": None}, "model.safetensors"),
    ],
)
def test_foreign_entries(folder, change, word):
    edit(folder, **change)
    refused(folder, word)


@pytest.mark.parametrize("key", ["format", "version", "prior", "config", "learned", "sha256"])
def test_missing_entries(folder, key):
    config = json.loads((folder / "config.json").read_text())
    del config[key]
    (folder / "config.json").write_text(json.dumps(config))
    refused(folder, "config.json", key)


class Poison:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


@pytest.mark.parametrize("how", ["pickle", "torch.save", "checksum"])
def test_nothing_is_executed(folder, how):
    touched = folder / "touched"
    path = folder / "model.safetensors"
    if how == "torch.save":
        torch.save({"x": Poison(touched)}, path)
    else:
        path.write_bytes(pickle.dumps(Poison(touched)))
    if how != "pickle":
        weights(folder, path.read_bytes())
    refused(folder, "model")
    (folder / "config.json").write_bytes(pickle.dumps(Poison(touched)))
    refused(folder, "config.json")
    assert not touched.exists()


def test_weights_of_another_model(folder, tmp_path):
    other = save(GRUPrior(A, hidden_size=16), tmp_path / "other")
    (folder / "model.safetensors").write_bytes((other / "model.safetensors").read_bytes())
    refused(folder, "model.safetensors")
    weights(folder, (other / "model.safetensors").read_bytes())
    refused(folder, "model")


JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-3, 20), st.floats(-3, 20), st.text(max_size=5)),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=5), inner, max_size=2),
    max_leaves=4,
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    value=JSON,
    key=st.sampled_from(
        [
            "prior",
            "config",
            "learned",
            "num_actions",
            "order",
            "initial",
            "smoothing",
            "hidden_size",
            "num_layers",
            "window",
            "num_contexts",
            "context_size",
        ]
    ),
)
def test_any_other_value_in_the_config_is_refused_or_fits(folder, key, value):
    before = (folder / "config.json").read_text()
    config = json.loads(before)
    where = config if key in config else config["config"]
    where[key] = value
    (folder / "config.json").write_text(json.dumps(config))
    try:
        prior = load(folder)
    except ValueError as error:
        prior, why = None, error
    finally:
        (folder / "config.json").write_text(before)
    if prior is None:
        assert says(why)
    else:
        assert prior.takes_context or prior.sample(2, 3, generator=seeded(0)).shape == (2, 3)


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
    place = folder / "config.json"
    place.write_text(place.read_text().replace('"num_actions": 3', '"num_actions": 1000000000000'))
    with pytest.raises(ValueError, match="would need at least"):
        load(folder)


@pytest.mark.parametrize("folder", ["", " ", 3, None])
def test_a_folder_has_a_name(folder, tmp_path, monkeypatch):
    """Without one a prior would be written among the files of the present folder."""
    monkeypatch.chdir(tmp_path)
    for call in (lambda: save(MarkovPrior(2, 0), folder), lambda: load(folder)):
        with pytest.raises(ValueError, match="`folder` must be the name of a folder, got"):
            call()
    assert not list(tmp_path.iterdir())
