"""The package as a whole: its version, and imports that leave torch as they found it."""

import importlib.metadata
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import ponn_torch

ROOT = Path(__file__).resolve().parents[1]

# Runs in a fresh interpreter, where nothing of the package has been imported yet. argv[1] is a statement that
# stands in for an ill-behaved module.
PROBE = """
import hashlib, importlib, json, pkgutil, random, sys
import numpy, torch

def globals_of_torch():
    digest = lambda state: hashlib.sha256(repr(state).encode()).hexdigest()
    return {
        "default_dtype": str(torch.get_default_dtype()),
        "default_device": str(torch.get_default_device()),
        "num_threads": torch.get_num_threads(),
        "num_interop_threads": torch.get_num_interop_threads(),
        "grad_enabled": torch.is_grad_enabled(),
        "inference_mode": torch.is_inference_mode_enabled(),
        "anomaly_detection": torch.is_anomaly_enabled(),
        "deterministic": torch.get_deterministic_debug_mode(),
        "float32_matmul_precision": torch.get_float32_matmul_precision(),
        "torch_rng": digest(torch.get_rng_state().tolist()),
        "numpy_rng": digest([numpy.asarray(part).tolist() for part in numpy.random.get_state()]),
        "python_rng": digest(random.getstate()),
    }

before = globals_of_torch()
import ponn_torch
names = [m.name for m in pkgutil.walk_packages(ponn_torch.__path__, "ponn_torch.")]
for name in names:
    importlib.import_module(name)
exec(sys.argv[1])
after = globals_of_torch()
print(json.dumps({"names": names, "changed": sorted(k for k in before if before[k] != after[k])}))
"""


def probe(statement: str = "pass") -> dict[str, list[str]]:
    run = subprocess.run(
        [sys.executable, "-c", PROBE, statement], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])


def test_importing_every_module_changes_no_torch_global() -> None:
    seen = probe()
    on_disk = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in (ROOT / "ponn_torch").rglob("*.py")
    }
    assert set(seen["names"]) == on_disk - {"ponn_torch"}
    assert seen["changed"] == []


def test_the_probe_notices_what_a_module_could_change() -> None:
    spoil = "torch.set_default_dtype(torch.float64); torch.set_num_threads(3); torch.rand(1)"
    assert probe(spoil)["changed"] == ["default_dtype", "num_threads", "torch_rng"]


@pytest.mark.parametrize("source", ["metadata", "pyproject"])
def test_version(source: str) -> None:
    versions = {
        "metadata": importlib.metadata.version("ponn-torch"),
        "pyproject": tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"],
    }
    assert ponn_torch.__version__ == versions[source]
