"""The front door: what `import jaxpose` and its rooms give, and what a user makes of these names alone."""

import importlib.metadata
import os
import pkgutil
import subprocess
import sys
import types

import pytest

import jaxpose

ROOMS = (
    "jaxpose datasets datasets.events datasets.photos datasets.rgbd datasets.synthetic evaluation events"
    " fields files geometry imu plots scenes slam training"
).split()
PACKAGES = [name if name == "jaxpose" else f"jaxpose.{name}" for name in ROOMS]


def python(code: str, **environment: str) -> str:
    """What a new interpreter prints."""
    found = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | environment,
    )
    return found.stdout.strip()


@pytest.mark.parametrize(
    "imported, others",
    [
        ("import jaxpose; jaxpose.__version__; jaxpose.__all__; dir(jaxpose)", {"lazy_loader"}),
        ("from jaxpose.errors import DataError", {"lazy_loader"}),
        ("from jaxpose.fields.numpy_evaluator import load", {"lazy_loader", "numpy"}),
    ],
)
def test_an_import_brings_what_it_needs_only(imported, others):
    code = f"import sys; before = set(sys.modules); {imported}; print(*(set(sys.modules) - before))"
    brought = {name.split(".")[0] for name in python(code).split()}
    assert brought - sys.stdlib_module_names <= {"jaxpose", *others}


@pytest.mark.parametrize("name", PACKAGES)
def test_every_name_of_a_room_is_there(name):
    package = importlib.import_module(name)
    assert package.__all__ and len(set(package.__all__)) == len(package.__all__)
    assert set(package.__all__) <= set(dir(package))
    for public in package.__all__:
        assert not public.startswith("_")
        assert getattr(package, public) is not None
    with pytest.raises(AttributeError, match="nonesuch"):
        package.nonesuch  # noqa: B018 - it is the access that fails


@pytest.mark.parametrize("name", PACKAGES)
def test_no_module_is_shadowed_by_a_name(name):
    package = importlib.import_module(name)
    for module in pkgutil.iter_modules(package.__path__):
        found = getattr(package, module.name, None) if module.name in package.__all__ else None
        assert found is None or isinstance(found, types.ModuleType), f"{name}.{module.name}"


def test_the_names_resolve_all_at_once():
    # Resolves every name while its package is still being imported, which a circle would not survive.
    assert "render_ray" in python("import jaxpose; print(dir(jaxpose))", EAGER_IMPORT="1")


def test_the_version_is_that_of_the_distribution():
    assert importlib.metadata.version("jaxpose") == jaxpose.__version__
