"""The direction of imports: every room imports only from rooms above it, or from itself."""

import ast
from pathlib import Path

import pytest

import jaxpose

LAYERS = (
    "errors _checks _terminal _memory geometry files nn nn_columns optim losses fields scenes render imu"
    " events estimate evaluation structure datasets training slam plots experiments cli __main__"
).split()
PACKAGE = Path(jaxpose.__file__).parent


def room(module: str) -> str:
    """The room of `jaxpose.x...`; empty for the package itself."""
    return module.removeprefix("jaxpose").lstrip(".").split(".")[0]


def imported(source: str) -> set[str]:
    """Dotted names that a module imports anywhere in it, `from a import b` as a.b."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import, write jaxpose..."
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def violations(sources: dict[str, str]) -> list[str]:
    """Every import that breaks a rule of the house, given the source of modules by name."""
    found = []
    for module, source in sources.items():
        own = room(module)
        if own and own not in LAYERS:
            found.append(f"{module} has no layer: add it to LAYERS")
        for name in sorted(imported(source)):
            if (name == "flax" or name.startswith("flax.linen")) and module != "jaxpose.nn":
                found.append(f"{module} imports {name}: only nn may import flax.linen")
            if name.split(".")[0] == "evo":
                found.append(f"{module} imports {name}: it is GPL, for tests only")
            other = room(name) if name.startswith("jaxpose.") else None
            if other not in LAYERS or own not in LAYERS:
                continue
            if LAYERS.index(other) > LAYERS.index(own):
                found.append(f"{module} imports {name} from below")
            takes_functions = own in ("render", "imu", "events")
            if takes_functions and other in ("fields", "scenes") and "fields.derivatives" not in name:
                found.append(f"{own} reaches {other}: it takes functions, whatever made them")
    return found


def test_the_house_keeps_its_layers():
    sources = {}
    for file in sorted(PACKAGE.rglob("*.py")):
        parts = file.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(("jaxpose", *parts)).removesuffix(".__init__")
        sources[name] = file.read_text()
    assert {"jaxpose", "jaxpose.errors", "jaxpose.datasets.rgbd.sevenscenes"} <= set(sources)
    assert violations(sources) == []


@pytest.mark.parametrize(
    "module, source",
    [
        ("jaxpose.fields.fitting", "import numpy\nimport jaxpose\nfrom jaxpose import __version__"),
        ("jaxpose.fields.fitting", "from jaxpose.fields.types import PoseField"),
        (
            "jaxpose.imu.simulation",
            "import jaxpose.imu\nfrom jaxpose.fields.derivatives import motion",
        ),
        ("jaxpose.nn", "import flax.linen as nn"),
        ("jaxpose.datasets.rgbd.euroc", "from jaxpose.files.ply import read_points"),
        ("jaxpose.experiments.imu_slam", "from jaxpose import fields, slam"),
    ],
)
def test_imports_from_above_are_fine(module, source):
    assert violations({module: source}) == []


@pytest.mark.parametrize(
    "module, source, message",
    [
        (
            "jaxpose.geometry.se3",
            "def f():\n    import jaxpose.fields.fitting",
            "imports jaxpose.fields.fitting from below",
        ),
        (
            "jaxpose.files.ply",
            "from jaxpose.datasets import images",
            "imports jaxpose.datasets.images from below",
        ),
        ("jaxpose.imu.simulation", "from jaxpose.fields import posenet", "imu reaches fields"),
        ("jaxpose.training.steps", "from flax import linen", "only nn may import flax.linen"),
        ("jaxpose.evaluation.trajectory_error", "import evo.core", "GPL"),
        ("jaxpose.helpers", "", "jaxpose.helpers has no layer"),
    ],
)
def test_imports_from_below_are_found(module, source, message):
    (found,) = violations({module: source})
    assert message in found
