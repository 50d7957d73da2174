"""The precision of a run's networks follows the processor, and stays with the run."""

import json
import warnings
from contextlib import nullcontext
from itertools import cycle
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf
from refusals import refused
from smoke import configure

from torchrl_mcp.runs import experiment, records
from torchrl_mcp.training import checkpoint, precision

X86 = {"architecture": "x86_64", "avx512_bf16": False, "amx_bf16": False}


@pytest.fixture
def processor(monkeypatch):
    """What makes torch see a processor of other features, on which bfloat16 takes ``ratio`` times as long."""

    def see(ratio=None, **features):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {**X86, **features})
        times = cycle([] if ratio is None else [ratio, 1.0])  # of the products, in the order in which they are timed
        monkeypatch.setattr(precision, "_seconds", lambda *operands: next(times))

    return see


@pytest.mark.parametrize(
    ("features", "ratio", "chosen"),
    [
        pytest.param({}, None, False, id="AVX2"),
        pytest.param({"amx_bf16": True, "avx512_bf16": True}, None, True, id="AMX"),
        pytest.param({"avx512_bf16": True}, 0.5, True, id="AVX512-BF16 that is fast"),
        pytest.param({"avx512_bf16": True}, 1.9, False, id="AVX512-BF16 that is slow"),
        pytest.param({"architecture": "arm64"}, 0.4, True, id="Arm with bfloat16"),
        pytest.param({"architecture": "arm64"}, 0.95, False, id="Arm that gains too little"),
    ],
)
def test_auto_takes_what_torch_says_of_the_processor_and_times_a_product_where_it_says_nothing(
    processor, features, ratio, chosen
):
    processor(ratio, **features)
    assert precision.choose("auto", "cpu").autocast is chosen


@pytest.mark.parametrize(("generation", "chosen"), [(7, False), (8, True)], ids=["Turing", "Ampere"])
def test_a_gpu_gets_bfloat16_from_the_generation_on_that_multiplies_it(monkeypatch, generation, chosen):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: SimpleNamespace(major=generation))
    monkeypatch.setattr(torch.cuda, "device", nullcontext)
    assert precision.choose("auto", "cuda").autocast is chosen


def test_the_time_of_a_product_is_that_of_this_machine_and_leaves_threads_and_random_numbers_alone():
    threads, numbers = torch.get_num_threads(), torch.get_rng_state()
    ratio = precision.relative_time("cpu")
    assert 0.02 < ratio < 1000
    assert torch.get_num_threads() == threads
    assert torch.equal(torch.get_rng_state(), numbers)


def test_bfloat16_on_a_processor_without_it_is_granted_with_a_warning_of_how_slow_it_is(processor):
    processor(9.25)
    with pytest.warns(UserWarning, match=r"takes 9\.2 times as long in bfloat16 as in float32; autocast=auto"):
        assert precision.choose(True, "cpu").autocast


def test_bfloat16_on_a_processor_that_has_it_needs_no_warning(processor):
    processor(amx_bf16=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert precision.choose(True, "cpu").autocast
        assert not precision.choose(False, "cpu").autocast


@pytest.mark.parametrize("value", ["fast", 1, None])
def test_another_precision_is_refused(value):
    refused(lambda: precision.choose(value, "cpu"), f"autocast={value!r}")


@pytest.mark.parametrize(("features", "word"), [({}, "float32"), ({"amx_bf16": True}, "bfloat16")])
def test_a_run_notes_the_choice_of_its_machine_and_keeps_it_on_another(
    tmp_path, processor, monkeypatch, capsys, features, word
):
    processor(**features)
    folder = tmp_path / "run"
    experiment.train(configure(folder, "autocast=auto", "training.total_frames=128"))
    chosen = word == "bfloat16"
    said = capsys.readouterr().out
    assert (f"networks in {word}: " in said) == chosen  # float32 needs no word
    origin = json.loads((folder / "origin.json").read_text())
    assert origin["precision"].startswith(f"networks in {word}: ")
    cfg = OmegaConf.load(folder / "config.yaml")
    assert cfg.autocast is chosen
    assert checkpoint.saved_config(checkpoint.find(folder))["autocast"] is chosen

    cfg.training.total_frames = 256
    OmegaConf.save(cfg, folder / "config.yaml")
    seen = []
    autocast = torch.autocast

    def watched(device, *dtype, enabled):
        seen.extend([enabled] * len(dtype))  # without a type, a layer leaves the precision of the run
        return autocast(device, *dtype, enabled=enabled)

    monkeypatch.setattr(torch, "autocast", watched)
    monkeypatch.setattr(records, "machine", lambda device: {"processor": "Another", "device": device})
    processor(ratio=5.0, amx_bf16=not chosen)
    with pytest.warns(UserWarning, match=r"5\.0 times as long") if chosen else nullcontext():
        experiment.resume(folder)
    said = capsys.readouterr().out
    assert "continues on Another (cpu)" in said
    assert f"with networks in {word}" in said
    assert set(seen) == {chosen}


def test_the_paper_s_preset_is_in_float32_whatever_the_machine_has():
    assert configure("run", "preset=paper").autocast is False
    assert configure("run", "preset=fast").autocast == "auto"
