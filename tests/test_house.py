"""The house's own rules: how long things are, and what a public function says of itself."""

import ast
import re
from pathlib import Path

import jaxpose

PACKAGE = Path(jaxpose.__file__).parent
LINES_OF_A_FILE, LINES_OF_A_FUNCTION = 400, 60

# What is longer today. These may shrink, and go when they are short enough; nothing is added.
LONG_FILES = {"geometry/se3.py": 445}
LONG_FUNCTIONS = {
    "imu/filtering.py filter_imu": 66,
}
# Public functions whose docstring lacks Args or Returns. They go as they get them; nothing is added.
SILENT = {f"{room}.{name}" for room, names in {
    "slam": "finish load run save",
}.items() for name in names.split()}  # fmt: skip


def lengths() -> tuple[dict[str, int], dict[str, int]]:
    """Lines of the files and functions that are too long."""
    files, functions = {}, {}
    for file in sorted(PACKAGE.rglob("*.py")):
        name, source = file.relative_to(PACKAGE).as_posix(), file.read_text()
        files[name] = len(source.splitlines())
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno:
                functions[f"{name} {node.name}"] = node.end_lineno - node.lineno + 1
    assert len(files) > 100 and len(functions) > 500
    long = lambda counts, most: {name: count for name, count in counts.items() if count > most}
    return long(files, LINES_OF_A_FILE), long(functions, LINES_OF_A_FUNCTION)


def test_no_file_and_no_function_grows_too_long():
    for found, known in zip(lengths(), (LONG_FILES, LONG_FUNCTIONS), strict=True):
        assert {name: count for name, count in found.items() if count > known.get(name, 0)} == {}
        assert known.keys() <= found.keys(), "short enough now: take it out of the list"


def public_functions() -> dict[str, ast.FunctionDef]:
    """Functions that a package names in its stub, and those of modules that it names, as room.function."""
    found = {}
    for stub in sorted(PACKAGE.rglob("__init__.pyi")):
        for node in ast.parse(stub.read_text()).body:
            if not isinstance(node, ast.ImportFrom):
                continue
            for alias in node.names:
                file = stub.parent.joinpath(*(node.module or alias.name).split(".")).with_suffix(".py")
                if not file.is_file():
                    continue  # of another package, which has a stub of its own
                room = ".".join(file.relative_to(PACKAGE).parts[:-1] or ("jaxpose",))
                for inner in ast.parse(file.read_text()).body:
                    if isinstance(inner, ast.FunctionDef) and not inner.name.startswith("_"):
                        if node.module is None or inner.name == alias.name:
                            found[f"{room}.{inner.name}"] = inner
    return found


def lacks(function: ast.FunctionDef) -> str:
    """Which parts a docstring does not have."""
    text, arguments = ast.get_docstring(function) or "", function.args
    parts = []
    if arguments.posonlyargs or arguments.args or arguments.kwonlyargs:
        parts.append("Args")
    if function.returns is None or ast.unparse(function.returns) != "None":
        parts.append("Returns")
    return " ".join(part for part in parts if f"\n{part}:\n" not in text)


def test_public_functions_say_what_they_take_and_give():
    functions = public_functions()
    assert {"fields.fit", "jaxpose.render_ray", "geometry.exp"} <= functions.keys()
    silent = {name for name, function in functions.items() if lacks(function)}
    assert silent - SILENT == set()


def test_files_are_opened_in_one_place():
    """There a pipe and a device are refused; folders whose files others wrote open none by themselves."""
    own = re.compile(r"\b(path|file|folder)\.open\(|\.read_(bytes|text)\(|FileIO\(|(?<![\w.])(?<!def )open\(")
    places = {
        f"{file.relative_to(PACKAGE)}:{number}: {line.strip()}"
        for room in ("files", "datasets", "evaluation")
        for file in sorted((PACKAGE / room).rglob("*.py"))
        for number, line in enumerate(file.read_text().splitlines(), 1)
        if own.search(line) and file.name not in ("opening.py", "atomic.py", "run_folder.py")
    }
    assert places == set()
