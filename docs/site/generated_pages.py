"""Pages of the site that are made from the program: public names, plans, messages and examples."""

from __future__ import annotations

import ast
import importlib
import inspect
import itertools
import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

from markdown_dialect import without_roles
from public_names import ROOMS, described_at, public_names

import phasemark
from phasemark import InputFileError, OutputExistsError, StorageError, UsageError
from phasemark.data.plans.frame_plan import SPREAD_SCHEMA, Distribution
from phasemark.matcher.plan_kinds import KINDS, plan_schema
from phasemark.matcher.sweep.plan import AXES_SCHEMA, Condition

ROOT = Path(__file__).resolve().parent.parent.parent
SOURCES = ("inputs", "landmarks", "render", "data", "matcher")
RAISED = (UsageError, InputFileError, OutputExistsError, StorageError)


def reference_path(module: str) -> str:
    """Return the page of a module's public names."""
    return f"reference/{module}.md"


def first_script_names() -> str:
    """Return the names that the root module takes from the rooms, as the code that uses them."""
    own = public_names()["phasemark"]
    return ", ".join(f"`pm.{name}`" for name in phasemark.__all__ if name not in (*own, "__version__"))


def first_line(thing: object) -> str:
    """Return the first sentence of what a docstring says."""
    text = inspect.cleandoc(getattr(thing, "__doc__", None) or "").split("\n\n")[0]
    return without_roles(" ".join(text.split()))


def reference_page(*, linked: bool) -> str:
    """Return the page that lists all public names: those of the rooms with their meanings, the others by module.

    Parameters
    ----------
    linked : bool
        Whether names lead to their own descriptions, which the site alone has.

    Returns
    -------
    str
    """
    lines = [
        "# Public names",
        "",
        "Generated from the package by `make pages`; do not edit. What may be imported from where. "
        f"`import phasemark as pm` also gives {first_script_names()}. "
        "Anything else is internal and may change. The site has a page for each of these modules, with parameters, "
        "results and errors of every name; `help(NAME)` in Python prints the same.",
        "",
    ]

    def label(module: str, name: str) -> str:
        return f"[`{name}`]({reference_path(module)}#{described_at(module, name)})" if linked else f"`{name}`"

    modules = ["## Modules within the rooms", "", "Names beside those of the room.", ""]
    public = public_names()
    for module, names in public.items():
        thing = importlib.import_module(module)
        if module in ROOMS:
            heading = f"[{module}]({reference_path(module)})" if linked else module
            lines += [f"## {heading}", "", first_line(thing), ""]
            lines += [f"- {label(module, name)}: {_described(thing, name)}" for name in names]
            lines.append("")
        else:
            place = f"[`{module}`]({reference_path(module)})" if linked else f"`{module}`"
            of_room = public[".".join(module.split(".")[:2])] if module.count(".") > 1 else []
            named = ", ".join(label(module, name) for name in names if name not in of_room)
            modules.append(f"- {place}: {named}")
    return "\n".join([*lines, *modules, ""])


def _described(module: ModuleType, name: str) -> str:
    """Return the first sentence of what a public name is; a constant has it in the text below its assignment."""
    value = getattr(module, name)
    if inspect.isroutine(value) or inspect.isclass(value):
        return first_line(value)
    for path in (ROOT / room for room in _sources(module)):
        body = ast.parse(path.read_text(encoding="utf-8")).body
        for statement, after in itertools.pairwise(body):
            targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
            if any(isinstance(target, ast.Name) and target.id == name for target in targets):
                if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                    text = str(after.value.value).split("\n\n")[0]
                    return without_roles(" ".join(text.split()))
    return ""


def _sources(module: ModuleType) -> list[str]:
    """Return the files in which a public name of a module may be assigned."""
    place = module.__name__.removeprefix("phasemark").lstrip(".").replace(".", "/")
    folder = ROOT / place
    files = sorted(folder.rglob("*.py")) if folder.is_dir() and place else [folder.with_suffix(".py")]
    return [str(path.relative_to(ROOT)) for path in files]


def reference_pages() -> dict[str, str]:
    """Return a page for each module with public names."""
    pages = {}
    for module, names in public_names().items():
        thing = importlib.import_module(module)
        items = [f"- [`{name}`](#{described_at(module, name)}): {_described(thing, name)}" for name in names]
        body = [line for name in names for line in (f"::: {described_at(module, name)}", "")]
        head = [f"# {module}", "", first_line(thing), "", *items, ""]
        pages[reference_path(module)] = "\n".join([*head, *body])
    return pages


def _type(schema: dict[str, Any], key: dict[str, Any]) -> str:
    """Return in words what a key of a plan takes."""
    if "$ref" in key:
        return _linked(key["$ref"].rpartition("/")[2])
    if key.get("anyOf") == SPREAD_SCHEMA["anyOf"]:
        return f"number or {_linked(Distribution.__name__)}"
    for several in ("anyOf", "oneOf"):
        if several in key:
            stated = [each for each in key[several] if each.get("type") != "null"]  # TOML has no null: left out
            return " or ".join(dict.fromkeys(_type(schema, each) for each in stated))
    if "enum" in key or "const" in key:
        return ", ".join(f"`{word}`" for word in key.get("enum", [key.get("const")]))
    if key.get("type") == "array":
        return f"list of {_items(schema, key)}"
    if key.get("type") == "object":
        inner = key.get("additionalProperties")
        return f"table of {_type(schema, inner)}" if isinstance(inner, dict) else "table"
    words = {
        "number": "number",
        "integer": "integer",
        "string": "text",
        "boolean": "true or false",
    }
    limits = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    stated = [f"{sign} {limit(key[name])}" for name, sign in limits.items() if isinstance(key.get(name), int | float)]
    return " ".join([words.get(key.get("type", ""), "any"), ", ".join(stated)]).strip()


def _linked(table: str) -> str:
    """Return a table's name as a link to its section."""
    return f"[{table}](#{table.lower()})"


def _items(schema: dict[str, Any], key: dict[str, Any]) -> str:
    """Return in words what a list takes: how many values, and of which kind."""
    kinds = dict.fromkeys(_type(schema, each) for each in key.get("prefixItems", [key.get("items", {})]))
    count = f"{key['maxItems']} " if key.get("maxItems") and key.get("maxItems") == key.get("minItems") else ""
    return count + _plural(*kinds) if len(kinds) == 1 else f"{count}values: {'; '.join(kinds)}"


def _plural(kind: str) -> str:
    """Return a kind of value in the plural; words of the program and names of tables stay as they are."""
    for one, many in (("integer", "integers"), ("number", "numbers"), ("text", "texts"), ("list", "lists")):
        if kind.startswith(one):
            return many + kind.removeprefix(one)
    return kind


def limit(value: float) -> str:
    """Return a limit as a person would write it: groups of three digits, and powers of two where they are meant.

    Examples
    --------
    >>> limit(2**64 - 1), limit(1_000_000), limit(0.5)
    ('2⁶⁴ − 1', '1 000 000', '0.5')
    """
    for exponent in (31, 32, 62, 63, 64):  # of seeds and counts
        power = "2" + "".join("⁰¹²³⁴⁵⁶⁷⁸⁹"[int(digit)] for digit in str(exponent))
        if value in (2**exponent, 2**exponent - 1):
            return power if value == 2**exponent else f"{power} − 1"
    if value == int(value) and abs(value) >= 10_000:
        return f"{int(value):,}".replace(",", " ")
    return f"{value:g}".replace("-", "−")


def _explained(docstring: str) -> dict[str, str]:
    """Return what the Parameters section of a numpydoc docstring says of each parameter."""
    section = re.search(r"^Parameters\n-+\n(.*?)(?=^\w[\w ]*\n-+\n|\Z)", docstring, flags=re.MULTILINE | re.DOTALL)
    found: dict[str, str] = {}
    names: list[str] = []
    for line in section[1].splitlines() if section else ():
        if line[:1].strip():
            names = [name.strip() for name in line.partition(" : ")[0].split(",")]
        for name in names if not line[:1].strip() else ():
            found[name] = f"{found.get(name, '')} {line.strip()}".strip()
    return found


_LONGEST_DEFAULT = 60


def _default(value: object, taken: str) -> str:
    """Return a default as a plan would state it, or where it is stated if it is a table of its own."""
    stated = _stated(value)
    return f"as in {taken}" if len(stated) > _LONGEST_DEFAULT and taken.startswith("[") else stated


def _stated(value: object) -> str:
    if isinstance(value, list) and value and all(isinstance(each, dict) and "name" in each for each in value):
        return ", ".join(f"one named `{each['name']}`" for each in value)
    if isinstance(value, dict):
        stated = {key: each for key, each in value.items() if each is not None}
        if list(stated) == ["fixed"]:
            return f"`{stated['fixed']}`"
        value = "{ " + ", ".join(f"{key} = {each}" for key, each in stated.items()) + " }" if stated else ""
    if value in ("", []):
        return "empty"
    if isinstance(value, list):
        value = json.dumps(value)  # as TOML writes lists of numbers and words, too
    return "none" if value is None else f"`{str(value).lower() if isinstance(value, bool) else value}`"


def _items_of(schema: dict[str, Any], model: dict[str, Any]) -> Iterator[str]:
    required = model.get("required", [])
    explained = _explained(model.get("description", ""))
    for name, key in model.get("properties", {}).items():
        taken = AXES_LINK if key.get("properties") == AXES_SCHEMA["properties"] else _type(schema, key)
        default = "required" if name in required else _default(key["default"], taken) if "default" in key else "empty"
        text = explained.get(name) or explained.get(f"{name}_name") or key.get("description", "")
        yield f"- `{name}` ({taken}; {default}): {without_roles(' '.join(text.split()))}"


AXES_LINK = "table of [axes](#axes-of-a-sweep)"


def _list_of_axes() -> list[str]:
    """Return the section of the axes of a sweep."""
    explained = _explained(inspect.cleandoc(Condition.__doc__ or ""))
    takes = "Each takes one value, a list of values, or `START:STOP:STEP` as a text."
    assumed = "A method takes bearing, height, pitch and roll to be 0 unless it estimates them."
    lines = ["### Axes of a sweep", "", f"{takes} {assumed}", ""]
    for name, axis in AXES_SCHEMA["properties"].items():
        value, default = axis["anyOf"][1], _stated(getattr(Condition, name))
        lines.append(f"- `{name}` ({_type({}, value)}; {default}): {explained[name]}")
    return [*lines, ""]


def _list_of_keys(items: Iterable[str]) -> list[str]:
    """Return a list of keys; neighbours that differ in their names alone share an item."""
    lines = []
    for rest, same in itertools.groupby(items, key=lambda item: item.partition("` ")[2]):
        lines.append(f"- {', '.join(f'`{_key_of(item)}`' for item in same)} {rest}")
    return [*lines, ""]


def _key_of(item: str) -> str:
    """Return the key that an item explains."""
    return item.split("`")[1]


def plans_page() -> str:
    """Return the page of plans: every key of every kind."""
    lines = [
        "# Plans",
        "",
        "Generated from the program by `make pages`; do not edit. A plan is a TOML file: what is built or run. "
        "`phasemark plan example KIND` prints one, `phasemark plan check FILE` says what is wrong with one, and "
        "`phasemark plan schema KIND` prints the JSON Schema from which this page is made. In brackets: what a key "
        "takes, and its default.",
        "",
    ]
    tables: dict[str, dict[str, Any]] = {}
    schemas = {kind: plan_schema(kind) for kind in KINDS}
    counts = Counter(item for schema in schemas.values() for item in _items_of(schema, schema))
    shared: dict[str, str] = {}
    for item, count in counts.items():
        if count > 1:
            shared.setdefault(_key_of(item), item)
    lines += ["## Keys of several kinds of plan", "", *_list_of_keys(shared.values())]
    for kind, schema in schemas.items():
        items = list(_items_of(schema, schema))
        own = [item for item in items if item not in shared.values()]
        lines += [f"## A plan of kind `{kind}`", "", *_list_of_keys(own)]
        named = [f"`{_key_of(item)}`" for item in items if item not in own]
        if named:
            lines += [f"Also [explained above](#keys-of-several-kinds-of-plan): {', '.join(named)}.", ""]
        tables.update(schema.get("$defs", {}))
    tables[Distribution.__name__] = Distribution.model_json_schema()
    lines += ["## Tables within plans", "", *_list_of_axes()]
    for name, model in sorted(tables.items()):
        if model.get("properties"):
            lines += [f"### {name}", "", *_list_of_keys(_items_of({}, model))]
        else:
            lines += [f"### {name}", "", _type({}, model), ""]
    return "\n".join(lines)


def _template(node: ast.expr) -> str | None:
    """Return the text of a message, with its values as ``…``."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        text = "".join(part.value if isinstance(part, ast.Constant) else "…" for part in node.values)
        return re.sub("…+", "…", text)  # two values beside each other
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = _template(node.left), _template(node.right)
        return None if left is None or right is None else left + right
    return None


def messages() -> dict[str, set[str]]:
    """Return the messages that each class of error is raised with, values as ``…``."""
    found: dict[str, set[str]] = {error.__name__: set() for error in RAISED}
    for room in SOURCES:
        for path in sorted((ROOT / room).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in found):
                    continue
                text = _template(node.args[0]) if node.args else None
                if text and len(re.findall(r"[a-z]{3}", text)) > 1:
                    found[node.func.id].add(" ".join(text.split()))
    return found


def messages_page() -> str:
    """Return the page of exit codes and messages."""
    lines = [
        "# Messages",
        "",
        "A mistake that you can mend is one line on standard error and an [exit code](../errors.md). These are the "
        "lines, taken from the program; `…` stands for the file, key or value at hand. In Python the same line is the "
        "text of the exception; there it names parameters where the command line names flags.",
        "",
    ]
    for error in RAISED:
        texts = sorted(messages()[error.__name__], key=lambda text: text.lstrip("…: '\"").lower())
        lines += [f"## {error.__name__}: exit code {error.exit_code}", "", first_line(error), ""]
        lines += [f"- `{text.replace('`', chr(39))}`" for text in texts]
        lines.append("")
    return "\n".join(lines)


def examples_page() -> str:
    """Return the page of the scripts in examples/, whole."""
    lines = ["# Example scripts", "", "The scripts of the folder `examples`. Each explains itself with `--help`.", ""]
    for path in sorted((ROOT / "examples").iterdir()):
        if path.suffix in (".py", ".toml"):
            language = {".py": "python", ".toml": "toml"}[path.suffix]
            lines += [f"## {path.name}", "", f"```{language}", path.read_text(encoding="utf-8").rstrip(), "```", ""]
    return "\n".join(lines)


def site_pages() -> dict[str, str]:
    """Return the pages that the site alone has, or has with more links, by their paths."""
    return {
        **reference_pages(),
        "reference.md": reference_page(linked=True),
        "reference/messages.md": messages_page(),
        "reference/examples.md": examples_page(),
    }


WRITTEN = {"reference.md": partial(reference_page, linked=False), "plans.md": plans_page}
"""Pages of docs/ that are made from the program; docs/commands.py makes one more."""


def main() -> None:
    """Write the pages that the repository holds."""
    for name, page in WRITTEN.items():
        (ROOT / "docs" / name).write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
