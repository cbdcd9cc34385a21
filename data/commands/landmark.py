"""Commands of ``phasemark landmark``: the catalogue and mesh files."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from phasemark.data.commands.command import Shown
from phasemark.data.commands.console import echo, echo_facts, echo_json, echo_table, readable
from phasemark.data.commands.inputs import class_mesh, read_landmark
from phasemark.data.commands.options import ClassName, Force, Json, MeshReading, Out, a_class
from phasemark.data.commands.outputs import refuse_existing, refuse_input_files, write_file

if TYPE_CHECKING:
    from phasemark.landmarks import LandmarkSpec


def landmark_list(*, as_json: Json = False) -> None:
    """List the landmarks of the catalogue."""
    from phasemark.landmarks import catalog

    specs = catalog()
    if as_json:
        return echo_json([spec.model_dump(mode="json") for spec in specs.values()])
    rows = []
    for name, spec in specs.items():
        box = " × ".join(f"{side_m:g}" for side_m in (spec.box.length_m, spec.box.width_m, spec.box.height_m))
        rows.append((name, box, _describe_upper(spec), f"{spec.albedo:g}", f"{360 / spec.symmetry:g}°"))
    echo_table(("class", "box (m)", "upper part", "albedo", "repeats every"), rows)


def landmark_show(
    name_or_file: Annotated[str, Shown(autocompletion=a_class)],
    *,
    out: Out | None = None,
    mesh_reading: MeshReading,
    force: Force = False,
) -> None:
    """Draw a landmark: a shaded figure, and a page to turn it in 3D.

    Parameters
    ----------
    name_or_file
        A class, or an STL, PLY, OBJ or OFF file.
    out
        Folder that NAME.png and NAME.html go to.
    """
    from phasemark.data.files.folder_marker import made_folder
    from phasemark.landmarks import mesh_figure
    from phasemark.landmarks.figures import mesh_html

    name, mesh = read_landmark(name_or_file, mesh_reading)
    folder = out or Path()
    figure, page = folder / f"{name}.png", folder / f"{name}.html"
    refuse_existing([figure, page], force)
    with made_folder(folder):
        write_file(figure, mesh_figure(mesh, directions=True), force)
        write_file(page, mesh_html(mesh, readable(name)), force)
    echo(figure, page)


def landmark_export(name: ClassName, *, out: Out, force: Force = False) -> None:
    """Write a landmark of the catalogue as a mesh, in metres.

    Parameters
    ----------
    out
        The file; .stl, .ply, .obj or .off.
    """
    from phasemark.landmarks import export_mesh

    refuse_input_files([out])
    echo(write_file(out, export_mesh(class_mesh(name), out.suffix.removeprefix(".")), force))


def landmark_check(file: Path, *, mesh_reading: MeshReading, as_json: Json = False) -> None:
    """Check a mesh file and say what it holds.

    Parameters
    ----------
    file
        An STL, PLY, OBJ or OFF file.
    """
    from phasemark.landmarks import check_mesh
    from phasemark.landmarks.symmetry import MAX_SYMMETRY

    _, mesh = read_landmark(str(file), mesh_reading)
    checked = check_mesh(mesh)
    if as_json:
        return echo_json({"file": str(file), **checked.as_dict()})
    report = checked.as_dict()
    del report["warnings"]  # reading the file has put them on stderr
    n = report["symmetry"]
    report["symmetry"] = {1: "1 (none)", MAX_SYMMETRY: f"{n} (a body of revolution)"}.get(
        n, f"{n} (looks the same every {360 / n:g}° about z')"
    )
    echo_facts({"file": file, **report})


def _describe_upper(spec: LandmarkSpec) -> str:
    if spec.upper is None:
        return "none"
    fields = spec.upper.model_dump(exclude={"kind", "profile_m"})
    return " ".join([spec.upper.kind, *(f"{key.removesuffix('_m')} {value:g}" for key, value in fields.items())])
