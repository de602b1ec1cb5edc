"""The wheel carries the configs and runs from another folder, without the source tree."""

import json
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PIP = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "--no-input"]


def run(command: list[str], cwd: Path, **environment: str) -> str:
    done = subprocess.run(command, cwd=cwd, env=os.environ | environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    offline = ["--no-deps", "--no-index", "--no-build-isolation"]
    run([*PIP, "wheel", *offline, "--wheel-dir", str(folder), str(ROOT)], folder)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def site(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    run([*PIP, "install", "--no-deps", "--no-index", "--target", str(folder), str(wheel)], folder)
    return folder


def files_under(folder: Path, *patterns: str) -> set[str]:
    found = [path for pattern in patterns for path in folder.rglob(pattern)]
    return {path.relative_to(folder).as_posix() for path in found if path.is_file()}


def test_wheel_holds_the_package_and_the_configs_but_no_tests(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    code = {f"ponn_torch/{name}" for name in files_under(ROOT / "ponn_torch", "*.py", "py.typed")}
    configs = {f"ponn_torch/configs/{name}" for name in files_under(ROOT / "configs", "*")}
    assert "ponn_torch/py.typed" in code
    assert configs
    assert code | configs <= names
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert {name.split("/")[0] for name in names} == {"ponn_torch", f"ponn_torch-{version}.dist-info"}


def test_installed_package_is_imported_from_the_wheel(site: Path, tmp_path: Path) -> None:
    where = "import ponn_torch; print(ponn_torch.__file__)"
    printed = run([sys.executable, "-c", where], tmp_path, PYTHONPATH=str(site))
    assert Path(printed.strip()) == site / "ponn_torch" / "__init__.py"


def test_command_line_solves_from_another_folder(site: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "ponn_torch.cli"]
    assert "mars_landing" in run([*command, "--help"], tmp_path, PYTHONPATH=str(site))
    settings = ["problem=mars_landing", "continuation.values=[1.0,0.1,0.01]", "record=minimal"]
    printed = run([*command, *settings], tmp_path, PYTHONPATH=str(site))
    (folder,) = (tmp_path / "runs" / "mars_landing").iterdir()
    assert json.loads((folder / "certificate.json").read_text(encoding="utf-8"))["certified"] is True
    assert folder.name in printed
