"""What commands share: compiled steps are kept in the user's cache folder, unless the user said otherwise."""

import os
import subprocess
import sys

import pytest

from jaxpose.experiments import command

BEFORE = "import jax; from jaxpose.experiments import command\n"
LAZY = "from jaxpose.experiments import command\n"
ACTION = """
def action(on_update):
    import jax
    return str(jax.jit(lambda x: x * 2 + 1)(20.0))
print(command.guarded("test", action))
"""


def run(program, cache, **settings):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment |= {"XDG_CACHE_HOME": str(cache), "HOME": str(cache), **settings}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.mark.parametrize("program", [BEFORE + ACTION, LAZY + ACTION], ids=["before", "lazy"])
def test_compiled_steps_are_kept_for_the_next_run(tmp_path, program):
    assert run(program, tmp_path) == "41.0"
    kept = [file for file in tmp_path.rglob("*") if "jaxpose" in file.parts and file.is_file()]
    assert kept
    assert run(program, tmp_path) == "41.0"


def test_what_the_user_told_jax_goes_first(tmp_path):
    run(BEFORE + ACTION, tmp_path / "home", JAX_COMPILATION_CACHE_DIR=str(tmp_path / "mine"))
    assert any((tmp_path / "mine").iterdir()) and not (tmp_path / "home").exists()
    run(BEFORE + ACTION, tmp_path / "off", JAX_ENABLE_COMPILATION_CACHE="false")
    assert not [file for file in (tmp_path / "off").rglob("*") if file.is_file()]


def test_the_folder_is_one_users_alone(tmp_path, monkeypatch):
    folder = tmp_path / "jaxpose"
    folder.mkdir()
    folder.chmod(0o777)  # what is kept are programs
    assert command._is_own(folder) and folder.stat().st_mode & 0o777 == 0o755
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    assert not command._is_own(folder)


def test_a_damaged_entry_is_compiled_again(tmp_path):
    assert run(BEFORE + ACTION, tmp_path) == "41.0"
    kept = [file for file in (tmp_path / "jaxpose").iterdir() if file.stat().st_size > 100]
    assert kept
    for file in kept:
        file.write_bytes(file.read_bytes()[:50])
    assert run(BEFORE + ACTION, tmp_path) == "41.0"


def test_the_oldest_entries_go_when_there_are_too_many(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "CACHE_BYTES", 1000)
    for age in range(10):
        (tmp_path / f"{age}").write_bytes(bytes(150))
        os.utime(tmp_path / f"{age}", (1e9 - age, 1e9 - age))
    command._shrink(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "1", "2", "3", "4"]
    command._shrink(tmp_path)
    assert len(list(tmp_path.iterdir())) == 5
