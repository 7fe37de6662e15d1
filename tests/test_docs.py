"""The examples in docstrings, run as the tests are: strict dtypes, annotations checked."""

import ast
import doctest
import importlib
from pathlib import Path

import pytest

import jaxpose

PACKAGE = Path(jaxpose.__file__).parent
FILES = [file for file in sorted(PACKAGE.rglob("*.py")) if ">>> " in file.read_text()]


def docstrings(source: str) -> list[tuple[str, str, int]]:
    """Name, text and line of every docstring: of the module, its classes and functions, decorated or not."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (
            text := ast.get_docstring(node)
        ):
            found.append((getattr(node, "name", "module"), text, node.body[0].lineno))
    return found


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_examples_in_docstrings_print_what_they_say(file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # for examples that write
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    module = importlib.import_module(".".join(parts).removesuffix(".__init__"))
    runner, said, examples = doctest.DocTestRunner(verbose=False), [], 0
    for name, text, line in docstrings(file.read_text()):
        example = doctest.DocTestParser().get_doctest(text, dict(vars(module)), name, str(file), line)
        examples += len(example.examples)
        runner.run(example, out=said.append)
    assert not said, "".join(said)
    assert examples == file.read_text().count(">>> "), "an example outside a docstring is run by nobody"
