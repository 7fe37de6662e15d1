"""The direction of imports: every module imports only from layers above its own, or from its own."""

import ast
from pathlib import Path

import pytest

import jaxpose

LAYERS = (
    "errors numpy_field se3 camera nn fields motion intrinsic scenes render imu events losses metrics train"
    " recording nerf slam io data io_transforms plots command experiments commands cli"
).split()
BESIDE = {
    "ekf": "imu",
    "__main__": "cli",
}  # modules named unlike their layer; imu_simulation is plainly imu's
PACKAGE = Path(jaxpose.__file__).parent


def layer(module: str) -> str | None:
    """The layer of `jaxpose.x...`; None for the package itself and for what is no layer."""
    stem = module.removeprefix("jaxpose").lstrip(".").split(".")[0]
    named = [name for name in LAYERS if stem == name or stem.startswith(f"{name}_")]
    return max(named, key=len) if named else BESIDE.get(stem)


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
    imports = {module: imported(source) for module, source in sources.items()}
    above = {name: set() for name in LAYERS}  # layer -> layers it imports
    found = []
    for module, names in imports.items():
        own = layer(module)
        if own is None and module != "jaxpose":
            found.append(f"{module} has no layer: add it to LAYERS")
        for name in sorted(names):
            if (name == "flax" or name.startswith("flax.linen")) and module != "jaxpose.nn":
                found.append(f"{module} imports {name}: only nn may import flax.linen")
            if name.split(".")[0] == "evo":
                found.append(f"{module} imports {name}: it is GPL, for tests only")
            other = layer(name) if name.startswith("jaxpose.") else None
            if other is None:
                continue
            if own is None or LAYERS.index(other) > LAYERS.index(own):
                found.append(f"{module} imports {name} from below")
            else:
                above[own].add(other)
    for own in LAYERS:  # in order, so that what a layer reaches through others is known already
        above[own] |= {reached for other in above[own] for reached in above[other]}
    for own in ("render", "imu", "events"):
        found += [f"{own} reaches {other}" for other in ("fields", "scenes") if other in above[own]]
    return found


def test_the_house_keeps_its_layers():
    sources = {}
    for file in sorted(PACKAGE.rglob("*.py")):
        parts = file.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(("jaxpose", *parts)).removesuffix(".__init__")
        sources[name] = file.read_text()
    assert {"jaxpose", "jaxpose.errors", "jaxpose.io", "jaxpose.data.sevenscenes"} <= set(sources)
    assert violations(sources) == []


@pytest.mark.parametrize(
    "module, source",
    [
        ("jaxpose.fields.table", "import numpy\nimport jaxpose\nfrom jaxpose import se3, __version__"),
        ("jaxpose.fields.fit", "from jaxpose.fields.base import PoseField"),
        ("jaxpose.imu_simulation", "from jaxpose.imu import Imu\nimport jaxpose.motion"),
        ("jaxpose.nn", "import flax.linen as nn"),
        ("jaxpose.data.euroc", "from jaxpose.io import read_tum\nfrom jaxpose.io_ply import read_points"),
        ("jaxpose.experiments.imu_slam", "from jaxpose import fields, io, slam"),
    ],
)
def test_imports_from_above_are_fine(module, source):
    assert violations({module: source}) == []


@pytest.mark.parametrize(
    "module, source, message",
    [
        ("jaxpose.se3", "from jaxpose import camera", "jaxpose.se3 imports jaxpose.camera from below"),
        (
            "jaxpose.se3",
            "def f():\n    import jaxpose.fields.table",
            "imports jaxpose.fields.table from below",
        ),
        ("jaxpose.io", "from jaxpose.data import euroc", "imports jaxpose.data.euroc from below"),
        ("jaxpose.data.llff", "import jaxpose.io_transforms", "imports jaxpose.io_transforms from below"),
        ("jaxpose", "from jaxpose.se3 import exp", "jaxpose imports jaxpose.se3.exp from below"),
        ("jaxpose.imu_simulation", "from jaxpose.fields import posenet", "imu reaches fields"),
        ("jaxpose.train", "from flax import linen", "only nn may import flax.linen"),
        ("jaxpose.metrics", "import evo.core", "GPL"),
        ("jaxpose.helpers", "", "jaxpose.helpers has no layer"),
    ],
)
def test_imports_from_below_are_found(module, source, message):
    (found,) = violations({module: source})
    assert message in found


def test_scenes_are_not_reached_through_another_layer():
    sources = {"jaxpose.motion": "from jaxpose.fields import base", "jaxpose.events": "import jaxpose.motion"}
    assert violations(sources) == ["events reaches fields"]
