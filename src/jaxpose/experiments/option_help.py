"""Help of a command: its options from a dataclass, with the comments beside its fields as their texts.

The first screen shows the options that most people use, in groups; `--help-all` shows every option.
"""

import ast
import dataclasses
import inspect
import io
import re
import shutil
import textwrap
import tokenize
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import tyro

_WIDTH, _COLUMN = 110, 28

Groups = Mapping[str, tuple[str, ...]]


class Option(NamedTuple):
    """An option of a command, or a positional argument."""

    path: str  # names of the fields: "slam.field.width"
    flag: str  # "--field.width", or "DATA"
    values: str  # what it takes, as "INT"
    text: str
    default: str | None  # None: there is none to tell
    within: str  # title of the nested settings it belongs to; empty: the command's own


def options(config_type: type, hidden: Collection[str] = ()) -> list[Option]:
    """Every option of a config, those of nested dataclasses among them.

    Args:
        config_type: a dataclass as `tyro.cli` takes it.
        hidden: paths of fields that are no options.

    Returns:
        The options in the order of their fields.
    """
    return list(_options(config_type, _defaults(config_type), "", "", "", frozenset(hidden)))


def help_text(
    prog: str,
    config_type: type,
    description: str,
    groups: Groups,
    hidden: Collection[str] = (),
    *,
    everything: bool,
) -> str:
    """What `--help` prints, or with `everything` what `--help-all` prints.

    Args:
        prog: the command as it is typed.
        config_type: its options.
        description: what it does.
        groups: paths of the options of the first screen, by the title of their group.
        hidden: paths of fields that are no options.
        everything: whether to show the options of no group too.

    Returns:
        The text, as wide as the terminal.
    """
    found = {option.path: option for option in options(config_type, hidden)}
    positional = [option for option in found.values() if not option.flag.startswith("-")]
    named = {path for paths in groups.values() for path in paths}
    assert named <= found.keys(), f"no such options: {sorted(named - found.keys())}"
    sections = {title: [found[path] for path in paths] for title, paths in groups.items()}
    rest = [o for o in found.values() if o.path not in named and o.flag.startswith("-")]
    if everything or not groups:
        for option in rest:
            sections.setdefault(option.within or "more options" * bool(groups) or "options", []).append(
                option
            )
    width = min(shutil.get_terminal_size().columns, _WIDTH)
    usage = " ".join(["usage:", prog, *(option.flag for option in positional), "[OPTIONS]"])
    blocks = [usage, *(textwrap.fill(part, width) for part in _paragraphs(description))]
    if positional:
        blocks.append("\n".join(_entry(option, width) for option in positional))
    for title, some in sections.items():
        blocks.append("\n".join([textwrap.fill(f"{title}:", width), *(_entry(o, width) for o in some)]))
    if groups and not everything:
        blocks.append(f"{len(rest)} more options: {prog} --help-all")
    return "\n\n".join(blocks)


def _options(
    config_type: type, default: Any, path: str, prefix: str, within: str, hidden: frozenset[str]
) -> Iterator[Option]:
    hints = get_type_hints(config_type, include_extras=True)
    for own in _field_names(config_type):
        name = f"{path}{own}"
        if name in hidden:
            continue
        kind, marks = hints[own], ()
        if get_origin(kind) is Annotated:
            kind, *marks = get_args(kind)
        value = default.get(own) if isinstance(default, dict) else getattr(default, own)
        if _is_nested(kind):
            flat = any(getattr(mark, "name", None) == "" for mark in marks)
            inner = prefix if flat else f"{prefix}{own.replace('_', '-')}."
            about = _paragraphs(inspect.getdoc(kind) or "")[0].rstrip(".:")
            title = within if flat else f"--{inner}*  {about}"
            yield from _options(kind, value, f"{name}.", inner, title, hidden)
            continue
        flag = f"--{prefix}{own.replace('_', '-')}"
        if tyro.conf.Positional in marks:
            flag = own.upper()
        elif kind is bool and value:
            flag = f"--{prefix}no-{own.replace('_', '-')}"
        text = re.sub(r"\bNone: ", "default: ", _comments(config_type).get(own, ""))
        yield Option(name, flag, _values(kind), text, _shown(kind, value), within)


def _is_nested(kind: Any) -> bool:
    """Whether the options of a field are those of its type's own fields."""
    return isinstance(kind, type) and (dataclasses.is_dataclass(kind) or hasattr(kind, "_fields"))


def _field_names(kind: Any) -> list[str]:
    return (
        [f.name for f in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else list(kind._fields)
    )


def _defaults(config_type: type) -> dict[str, Any]:
    """The default of each field; MISSING where there is none."""
    found = {}
    for field in dataclasses.fields(config_type):
        made = field.default_factory
        found[field.name] = field.default if made is dataclasses.MISSING else made()
    return found


def _values(kind: Any) -> str:
    """What an option of a type takes, in words."""
    origin, inner = get_origin(kind), get_args(kind)
    if kind is bool or kind is NoneType:
        return ""
    if origin is Literal:
        return "{" + ",".join(map(str, inner)) + "}"
    if origin is tuple:
        return f"{_values(inner[0])} ..." if inner[-1] is Ellipsis else " ".join(map(_values, inner))
    if inner:  # a union
        found = [_values(part) for part in inner if part is not NoneType]
        literal = all(part.startswith("{") for part in found)
        return "{" + ",".join(part.strip("{}") for part in found) + "}" if literal else "|".join(found)
    names = {Path: "PATH", str: "TEXT"}
    return names[kind] if kind in names else str(kind.__name__).upper()


def _shown(kind: Any, value: Any) -> str | None:
    if value is None or value is dataclasses.MISSING or kind is bool:
        return None
    if isinstance(value, tuple):
        return " ".join(map(str, value)) or None
    return f"{value:g}" if isinstance(value, float) else str(value)


@cache
def _comments(config_type: type) -> dict[str, str]:
    """The comments above and beside each field, of its own class and of those it inherits from."""
    found: dict[str, str] = {}
    for base in reversed(config_type.__mro__):
        if not _is_nested(base):
            continue
        source = textwrap.dedent(inspect.getsource(base))
        tokens = tokenize.generate_tokens(io.StringIO(source).readline)
        comments = {
            token.start[0]: (token.string.lstrip("# "), not token.line.lstrip().startswith("#"))
            for token in tokens
            if token.type == tokenize.COMMENT
        }
        (tree,) = ast.parse(source).body
        assert isinstance(tree, ast.ClassDef)
        for node in tree.body:
            if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)):
                continue
            words, row = [], node.lineno - 1
            while row in comments and not comments[row][1]:
                words.insert(0, comments[row][0])
                row -= 1
            lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
            words += [comments[row][0] for row in lines if row in comments]
            if words or node.target.id not in found:
                found[node.target.id] = " ".join(words)
    return found


def _entry(option: Option, width: int) -> str:
    """An option with its text, as lines."""
    head = f"  {option.flag} {option.values}".rstrip() if option.flag.startswith("-") else f"  {option.flag}"
    text = option.text + (f" (default: {option.default})" if option.default is not None else "")
    gap = " " * _COLUMN
    if len(head) > _COLUMN - 2:
        return head + "\n" + textwrap.fill(text, width, initial_indent=gap, subsequent_indent=gap)
    return textwrap.fill(text, width, initial_indent=head.ljust(_COLUMN), subsequent_indent=gap)


def _paragraphs(text: str) -> list[str]:
    return [" ".join(part.split()) for part in inspect.cleandoc(text).split("\n\n")]
