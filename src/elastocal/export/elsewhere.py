"""The user's own file written into another folder: its meshes are found from there."""

from __future__ import annotations

import os
from pathlib import Path

from elastocal.model.mjcf import parsed
from elastocal.model.xml_file import Tag, XmlText, element

# Files that MuJoCo looks for beside the main file, whatever directories the compiler states.
BESIDE = ("include", "model")


def moved(path: Path, text: str, folder: Path | None) -> tuple[str, list[str]]:
    """The `text` of a file that lies at `path`, to be written into `folder`, and what to know.

    A file without names of others, or that stays where it was, is as before to the byte.
    """
    xml = XmlText(path, text.encode("utf-8"))
    named = [tag for tag in xml.tags if any(_is_file(tag, key) for key in tag.stated)]
    if not named:
        return text, []
    home, there = path.parent.resolve(), path.parent if folder is None else folder
    beside = [tag for tag in named if tag.name in BESIDE]
    if there.resolve() != home:
        if beside:
            return text, [f"copy it beside {path.name}: the files that it includes are there"]
        if xml.tags[0].name == "mujoco":
            _set_directories(xml, path, there.resolve())
        for tag in (tag for tag in named if "filename" in tag.stated):
            place = home / tag.stated["filename"]
            if place.is_file():  # others are found in packages
                xml.set(tag, {"filename": _from(there.resolve(), place)})
    told = "meshes and other files are named relative to the file: to have it elsewhere, export it"
    return xml.result(), [f"{told} there"]


def _is_file(tag: Tag, key: str) -> bool:
    name = tag.stated[key]
    if key == "filename":  # of a URDF
        relative = "://" not in name and not Path(name).is_absolute()
        return tag.name in ("mesh", "texture") and relative
    return key.startswith("file") and bool(name)


def _set_directories(xml: XmlText, path: Path, folder: Path) -> None:
    """Let the last <compiler> name the directories of meshes and textures from `folder`."""
    stated = parsed(path).compiler
    places = {key: _from(folder, path.parent.resolve() / (getattr(stated, key) or ""))
              for key in ("meshdir", "texturedir")}  # fmt: skip
    compilers = [tag for tag in xml.tags if tag.name == "compiler"]
    if compilers:
        xml.set(compilers[-1], places)
    else:
        xml.insert_in(xml.tags[0], f"\n  {element('compiler', places)}")


def _from(folder: Path, place: Path) -> str:
    try:
        return Path(os.path.relpath(place, folder)).as_posix()
    except ValueError:  # on another drive
        return place.as_posix()
