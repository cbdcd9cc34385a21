"""Card of an exported data set: README.md for people, and croissant.json (MLCommons Croissant 1.0) for programs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from phasemark.data.files.json_text import json_text
from phasemark.data.frames.frame_set_file import FrameSet, SceneFrameSet

_OWN_WORDS = (
    "arrayShape", "citeAs", "column", "equivalentProperty", "extract", "field", "fileObject", "fileProperty",
    "fileSet", "format", "includes", "isArray", "isLiveDataset", "jsonPath", "key", "md5", "parentField", "path",
    "recordSet", "references", "regex", "repeated", "replace", "samplingRate", "separator", "source", "subField",
    "transform",
)  # fmt: skip
_VOCABULARY: dict[str, Any] = dict(
    sorted(
        {
            "@language": "en",
            "@vocab": "https://schema.org/",
            "conformsTo": "dct:conformsTo",
            "cr": "http://mlcommons.org/croissant/",
            "data": {"@id": "cr:data", "@type": "@json"},
            "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
            "dct": "http://purl.org/dc/terms/",
            "examples": {"@id": "cr:examples", "@type": "@json"},
            "rai": "http://mlcommons.org/croissant/RAI/",
            "sc": "https://schema.org/",
            **{word: f"cr:{word}" for word in _OWN_WORDS},
        }.items()
    )
)
_KINDS = {"f": "sc:Float", "i": "sc:Integer", "u": "sc:Integer", "b": "sc:Boolean", "s": "sc:Text"}


class Column(NamedTuple):
    """Column of a data set: name, type of its values, and the shape of one row's."""

    name: str
    kind: str
    shape: tuple[int, ...]


def write_card(
    frames: FrameSet,
    folder: Path,
    layout: str,
    columns: Sequence[Column],
    files: Sequence[Mapping[str, str]],
    load: str,
) -> None:
    """Write README.md and croissant.json.

    Parameters
    ----------
    frames : FrameSet
    folder : Path
    layout : {"WebDataset", "LeRobot"}
    columns : sequence of Column
    files : sequence of mapping
        Name or pattern, MIME type and, of single files, SHA-256.
    load : str
        The line of Python that reads the data set.
    """
    (folder / "README.md").write_text(_readme(frames, layout, columns, load), encoding="utf-8")
    described = _croissant(frames, layout, columns, files)
    (folder / "croissant.json").write_text(json.dumps(described, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def _title(frames: FrameSet) -> str:
    of = f"scenes of {frames.plan.scenes.generator or 'files'}" if isinstance(frames, SceneFrameSet) else "landmarks"
    return f"Simulated time-of-flight frames: {of}"


def _facts(frames: FrameSet) -> str:
    facts = frames.info()
    return (
        f"{facts['frames']} frames of {facts['views']} views with the sensor {facts['sensor']}"
        f" ({facts['rows']} × {facts['cols']} pixels), simulated by phasemark {facts['versions']['phasemark']} with"
        f" seed {facts['seed']}. Ranges are along the ray, metres, NaN where there is none."
    )


def _readme(frames: FrameSet, layout: str, columns: Sequence[Column], load: str) -> str:
    facts = frames.info()
    lines = ["---", "tags:", "- time-of-flight", "- simulated", f"- {layout}"]
    if layout == "LeRobot":
        lines += ["task_categories:", "- robotics", "configs:", "- config_name: default"]
        lines += ["  data_files: data/*/*.parquet"]
    lines += ["---", "", f"# {_title(frames)}", "", _facts(frames), "", "```python", load, "```", ""]
    lines += ["| column | type | shape |", "|---|---|---|"]
    lines += [f"| `{one.name}` | {one.kind} | {' × '.join(map(str, one.shape)) or '1'} |" for one in columns]
    lines += ["", "| split | views |", "|---|---|"]
    lines += [f"| {split} | {count} |" for split, count in facts["views_of_split"].items()]
    if frames.classes:
        lines += ["", f"Classes, in the order of their numbers: {', '.join(frames.classes)}."]
    lines += ["", "The plan that makes it again:", "", "```json", json_text(frames.plan, indent=1), "```", ""]
    return "\n".join(lines)


def _croissant(
    frames: FrameSet, layout: str, columns: Sequence[Column], files: Sequence[Mapping[str, str]]
) -> dict[str, Any]:
    """Return the data set's description as JSON-LD."""
    distribution: list[dict[str, Any]] = []
    for one in files:
        name = one["name"]
        about = {"@id": name, "name": name, "encodingFormat": one["format"]}
        if "sha256" in one:
            distribution.append({"@type": "cr:FileObject", **about, "contentUrl": name, "sha256": one["sha256"]})
        else:
            distribution.append({"@type": "cr:FileSet", **about, "includes": name})
    described: dict[str, Any] = {
        "@context": _VOCABULARY,
        "@type": "sc:Dataset",
        "name": _title(frames),
        "description": _facts(frames),
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "version": "1.0.0",
        "distribution": distribution,
    }
    if layout == "LeRobot":
        described["recordSet"] = [_records(columns, files[0]["name"])]
    return described


def _records(columns: Sequence[Column], files: str) -> dict[str, Any]:
    """Return the description of the columns of Parquet files."""
    fields = []
    for one in columns:
        field: dict[str, Any] = {
            "@type": "cr:Field",
            "@id": f"frames/{one.name}",
            "name": one.name,
            "dataType": _KINDS[one.kind[0]],
            "source": {"fileSet": {"@id": files}, "extract": {"column": one.name}},
        }
        if one.shape:
            field |= {"isArray": True, "arrayShape": ",".join(map(str, one.shape))}
        fields.append(field)
    return {"@type": "cr:RecordSet", "@id": "frames", "name": "frames", "field": fields}
