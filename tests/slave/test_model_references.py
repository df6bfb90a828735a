"""Referenced files are read only inside the model folder and packages; no file ends the process."""

from __future__ import annotations

import base64
import json
import os
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.model import model_references
from drake_teleop.station.slave.model.model_references import ModelFiles, list_model_files
from drake_teleop.station.slave.models import ParsedArm, ParseModel

SOLID = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
LINK = """<link name="l"><inertial><mass>1</mass><inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz>
</inertia></inertial></link>"""
URDF_LINK = """<link name="l"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0"
iyy="1" iyz="0" izz="1"/></inertial><visual><geometry><mesh filename="{mesh}"/></geometry></visual>
</link>"""
OUTSIDE = "outside the model's folder"


def parse(path: Path, packages: tuple[Path, ...] = ()) -> ParsedArm:
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    found = ParseModel(plant, path, "l", packages)
    plant.Finalize()
    return found


def urdf(mesh: str) -> str:
    return f'<robot name="r">{URDF_LINK.format(mesh=mesh)}</robot>'


def sdf(inside: str) -> str:
    return f'<sdf version="1.9"><model name="m">{inside}</model></sdf>'


def including(uri: str) -> str:
    return sdf(f"<include><uri>{uri}</uri></include>")


def mjcf(inside: str) -> str:
    return f'<mujoco model="m">{inside}</mujoco>'


def directive(file: str, kind: str = "add_model") -> str:
    name = "name: m, " if kind == "add_model" else ""
    return f"directives: [{kind}: {{{name}file: '{file}'}}]"


def gltf(**more: object) -> dict:
    corners, faces = (0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1), (0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3)
    data = base64.b64encode(struct.pack("<12f12H", *corners, *faces)).decode()
    views = [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 24}]
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
    ]
    accessors[0] |= {"min": [0, 0, 0], "max": [1, 1, 1]}
    return {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"uri": f"data:application/octet-stream;base64,{data}", "byteLength": 72}],
        "bufferViews": views, "accessors": accessors,
    } | more  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder of a model, beside a secret file."""
    (tmp_path / "secret.png").write_bytes(b"secret")
    (tmp_path / "other.sdf").write_text(sdf('<link name="l"/>'))
    (tmp_path / "solid.obj").write_text(SOLID)
    (tmp_path / "model").mkdir()
    return tmp_path / "model"


def write(folder: Path, **files: str | dict) -> Path:
    """Write files, with _ for the point in their names; return the first."""
    paths = [folder / name.replace("_", ".", 1) for name in files]
    for path, content in zip(paths, files.values(), strict=True):
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return paths[0]


TWICE = '"images": [{"uri": "../secret.png", "uri": "x"}]'
IMAGES = {
    "absolute": lambda folder: gltf(images=[{"uri": str(folder.parent / "secret.png")}]),
    "relative": lambda _: gltf(images=[{"uri": "../secret.png"}]),
    "encoded": lambda _: gltf(images=[{"uri": "..%2Fsecret.png"}]),
    "file": lambda folder: gltf(images=[{"uri": f"file://{folder.parent}/secret.png"}]),
    "buffer": lambda _: gltf(buffers=[{"uri": "../secret.png", "byteLength": 6}]),
    "extension": lambda _: gltf(extensions={"x": {"y": [{"uri": "../secret.png"}]}}),
    "password": lambda _: gltf(images=[{"uri": "/etc/passwd"}]),
    "device": lambda _: gltf(buffers=[{"uri": "/dev/zero", "byteLength": 72}]),
    "twice": lambda _: (
        json.dumps(gltf())[:-1] + ', "images": [{"uri": "../secret.png", "uri": "x"}]}'
    ),
}


@pytest.mark.parametrize("name", IMAGES)
def test_gltf_reads_no_file_outside_folder(folder: Path, name: str) -> None:
    path = write(folder, a_urdf=urdf("x.gltf"), x_gltf=IMAGES[name](folder))
    assert any(OUTSIDE in words for words in parse(path).assumptions)


def test_a_binary_gltf_reads_no_file_outside(folder: Path) -> None:
    text = json.dumps(gltf(images=[{"uri": "../secret.png"}])).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON")
    (folder / "x.glb").write_bytes(head + text)
    with pytest.raises(DrakeTeleopError, match=OUTSIDE):
        ModelFiles(write(folder, a_urdf=urdf("x.glb")), ()).check_referenced_files(folder / "x.glb")


@pytest.mark.parametrize(
    ("library", "texture"),
    [
        ("x.mtl", "../secret.png"),
        ("x.mtl", "-bm 1 {root}/secret.png"),
        ("../x.mtl", "y.png"),
        ("/etc/passwd", ""),
    ],
)
def test_an_obj_reads_no_material_and_no_texture_outside(
    folder: Path, library: str, texture: str
) -> None:
    path = write(folder, a_urdf=urdf("x.obj"), x_obj=f"mtllib {library}\n{SOLID}")
    if texture:
        (folder / library).write_text(f"newmtl a\nmap_Kd {texture.format(root=folder.parent)}\n")
    assert any(OUTSIDE in words for words in parse(path).assumptions)


@pytest.mark.parametrize(
    "where",
    [
        *("../solid.obj", "{root}/solid.obj", "file://{root}/solid.obj", "link.obj"),
        *("package://home/solid.obj", "package://../solid.obj", "package://away/solid.obj"),
    ],
)
def test_mesh_outside_folder_is_removed_with_remedy(tmp_path: Path, where: str) -> None:
    home = tmp_path / "home"
    (home / "model").mkdir(parents=True)
    (home / "solid.obj").write_text(SOLID)
    (home / "model" / "link.obj").symlink_to(home / "solid.obj")
    (home / "model" / "away").symlink_to(home)
    path = write(home / "model", a_urdf=urdf(where.format(root=home)))
    (words,) = [words for words in parse(path).assumptions if "shapes" in words]
    assert "--package-path" in words
    if where.startswith(("package://..", "package://away")):
        return
    assert not any("shapes" in words for words in parse(path, (home,)).assumptions)
    (home / "package.xml").touch()  # a ROS package, as its author made it
    assert not any("shapes" in words for words in parse(path).assumptions)


def test_missing_package_folder_is_an_error(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text("<robot/>")
    with pytest.raises(DrakeTeleopError, match=r"the package folder .*/typo does not exist; corr"):
        parse(path, (tmp_path / "typo",))


@pytest.mark.parametrize("case", ["installed", "source", "no package", "home", "link", "neighbour"])
def test_model_reads_files_of_the_installed_python_package_around_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    package, mesh = tmp_path / "site-packages" / "robots", "../scene/solid.obj"
    (package / "assets" / "arm").mkdir(parents=True)
    (package / "assets" / "scene").mkdir()
    (package.parent / "solid.obj").write_text(SOLID)
    if case == "link":
        (package / "assets" / "scene" / "solid.obj").symlink_to(package.parent / "solid.obj")
    else:
        (package / "assets" / "scene" / "solid.obj").write_text(SOLID)
    if case != "no package":
        (package / "__init__.py").touch()
    if case != "source":
        (package.parent / "robots-1.0.dist-info").mkdir()
    if case == "neighbour":
        mesh = "../../../solid.obj"
    if case == "home":
        monkeypatch.setenv("HOME", str(package / "assets"))
    path = write(package / "assets" / "arm", a_urdf=urdf(mesh))
    assumed = parse(path).assumptions
    assert any(OUTSIDE in words for words in assumed) == (case != "installed")


def include_cycle(text: Callable[[str], str], *names: str) -> dict[str, str]:
    """Return files that include each other."""
    others = (*names[1:], names[0])
    return {name.replace(".", "_"): text(other) for name, other in zip(names, others, strict=True)}


INCLUDES: dict[str, tuple[Callable[[Path], dict[str, str]], str]] = {
    "sdf itself": (lambda _: include_cycle(including, "a.sdf"), "includes itself"),
    "sdf in a circle": (
        lambda _: include_cycle(including, "a.sdf", "b.sdf", "c.sdf"),
        "includes itself",
    ),
    "sdf by file": (lambda f: {"a_sdf": including(f"file://{f}/a.sdf")}, "includes itself"),
    "sdf outside": (lambda _: {"a_sdf": including("../other.sdf")}, OUTSIDE),
    "a fifo": (lambda _: {"a_sdf": including("fifo.sdf")}, "which does not exist"),
    "mjcf itself": (
        lambda _: include_cycle(lambda to: mjcf(f'<include file="{to}"/>'), "a.xml"),
        "includes itself",
    ),
    "mjcf in a circle": (
        lambda _: include_cycle(
            lambda to: mjcf(f'<worldbody><include file="{to}"/></worldbody>'), "a.xml", "b.xml"
        ),
        "includes itself",
    ),
    "mjcf mesh": (
        lambda _: {"a_xml": mjcf('<asset><mesh file="../solid.obj"/></asset>')},
        OUTSIDE,
    ),
    "mjcf device": (
        lambda _: {"a_xml": mjcf('<asset><mesh file="/dev/zero"/></asset>')},
        OUTSIDE,
    ),
    "mjcf mesh in a folder": (
        lambda f: {
            "a_xml": mjcf(
                f'<asset><mesh file="solid.obj"/></asset><compiler meshdir="{f.parent}"/>'
            )
        },
        OUTSIDE,
    ),
    "mjcf texture of an include": (
        lambda _: {
            "a_xml": mjcf('<include file="b.xml"/><include file="c.xml"/>'),
            "b_xml": mjcf('<asset><texture file="secret.png"/></asset>'),
            "c_xml": mjcf('<compiler texturedir=".."/>'),
        },
        OUTSIDE,
    ),
    "directives themselves": (
        lambda f: include_cycle(
            lambda to: directive(f"file://{f}/{to}", "add_directives"), "a.yaml"
        ),
        "includes itself",
    ),
    "directives through a folder that is not there": (
        lambda f: {"a_yaml": directive(f"file://{f}/none/../a.yaml", "add_directives")},
        "includes itself",
    ),
    "directives in a circle": (
        lambda f: include_cycle(
            lambda to: directive(f"file://{f}/{to}", "add_directives"), "a.yaml", "b.yaml"
        ),
        "includes itself",
    ),
    "directives outside": (
        lambda f: {"a_yaml": directive(f"file://{f.parent}/other.sdf")},
        OUTSIDE,
    ),
    "directives, a mesh outside": (
        lambda f: {"a_yaml": directive(f"file://{f}/b.urdf"), "b_urdf": urdf("../solid.obj")},
        OUTSIDE,
    ),
    "package of Drake": (
        lambda _: {"a_yaml": directive(f"package://drake/{'../' * 30}etc/passwd")},
        OUTSIDE,
    ),
    "thrice as many each time": (
        lambda _: (
            {
                f"m{k}_sdf": sdf(
                    "".join(
                        f"<include><name>{name}</name><uri>m{k + 1}.sdf</uri></include>"
                        for name in "abc"
                    )
                )
                for k in range(12)
            }
            | {"m12_sdf": sdf(LINK)}
        ),
        "exceeds the limit of 2000 files",
    ),
    "a long way": (
        lambda _: (
            {f"m{k}_sdf": including(f"m{k + 1}.sdf") for k in range(300)} | {"m300_sdf": sdf(LINK)}
        ),
        "is nested too deeply",
    ),
}


@pytest.mark.parametrize("name", INCLUDES)
def test_invalid_include_raises_one_line(folder: Path, name: str) -> None:
    make, says = INCLUDES[name]
    os.mkfifo(folder / "fifo.sdf")
    path = write(folder, **make(folder))
    with pytest.raises(DrakeTeleopError, match=says):
        parse(path)


def test_long_file_name_raises_one_line(folder: Path) -> None:
    """Drake's regular expression for addresses aborts on a long one."""
    long = "file://" + "a" * 30_000
    path = folder / "a.yaml"
    path.write_text(f"directives: [add_directives: {{file: '{long}'}}]")
    with pytest.raises(DrakeTeleopError, match="30007 characters"):
        parse(path)


def test_joint_loop_raises_one_line(folder: Path) -> None:
    moments = 'ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"'
    inertia = f'<inertial><mass value="1"/><inertia {moments}/></inertial>'
    links = "".join(f'<link name="{name}">{inertia}</link>' for name in "lab")
    joints = "".join(
        f'<joint name="{p}{c}" type="revolute"><parent link="{p}"/><child link="{c}"/></joint>'
        for p, c in ("la", "ab", "bl")
    )
    path = folder / "a.urdf"
    path.write_text(f'<robot name="r">{links}{joints}</robot>')
    with pytest.raises(DrakeTeleopError):
        parse(path)


def test_file_in_working_folder_is_outside_model(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drake resolves nested includes from the working directory."""
    monkeypatch.chdir(folder.parent)
    path = write(folder, a_sdf=including("b.sdf"), b_sdf=including("other.sdf"))
    with pytest.raises(DrakeTeleopError, match=OUTSIDE):
        parse(path)


def test_too_large_files_are_rejected(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(folder, a_urdf=urdf("x.gltf"), x_gltf=gltf())
    monkeypatch.setattr(model_references, "_MAX_TEXT_FILE_BYTES", 400)
    assert any("exceeds the limit" in words for words in parse(path).assumptions)
    monkeypatch.setattr(model_references, "_MAX_TEXT_FILE_BYTES", 100)
    with pytest.raises(DrakeTeleopError, match=r"a\.urdf: the model exceeds the limit of"):
        parse(path)


@pytest.mark.parametrize("name", ["model", "robots #2", "a b%20", "ä:b"])
def test_files_inside_are_read_from_any_working_folder(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / name
    for inner in ("parts", "inner"):
        (folder / inner).mkdir(parents=True)
    materials = "newmtl a\nmap_Kd a.png\n"
    solid = f"mtllib solid.mtl\n{SOLID}"
    write(folder / "parts", solid_obj=solid, solid_mtl=materials, a_png="")
    config = "<model><sdf version='1.9'>a.sdf</sdf></model>"
    write(folder / "inner", model_config=config, a_sdf=sdf(LINK))
    monkeypatch.chdir(tmp_path)
    path = write(folder, a_urdf=urdf("parts/solid.obj"))
    assert not any("shapes" in words for words in parse(path).assumptions)
    for k, uri in enumerate(("inner", "inner/a.sdf", "model://inner")):
        path = write(folder, **{f"b{k}_sdf": including(uri)})
        assert parse(path).sensor_frame.name() == "l"
    body = '<body name="l"><geom type="mesh" mesh="solid"/></body>'
    asset = '<asset><mesh name="solid" file="solid.obj"/></asset>'
    path = write(
        folder,
        c_xml=mjcf(f'<include file="d.xml"/><worldbody>{body}</worldbody>'),
        d_xml=mjcf(f'<compiler meshdir="parts"/>{asset}'),
    )
    assert parse(path).sensor_frame.name() == "l"


@pytest.mark.parametrize(
    ("name", "text", "mesh"),
    [
        ("r.urdf", urdf("meshes/a.obj"), "meshes/a.obj"),
        ("r.urdf", urdf("package://parts/a.obj"), "parts/a.obj"),
        ("r.sdf", including("inner.urdf"), "meshes/a.obj"),
        (
            "r.xml",
            mjcf('<compiler meshdir="meshes"/><asset><mesh file="a.obj"/></asset>'),
            "meshes/a.obj",
        ),
        (
            "r.xml",
            mjcf(
                '<compiler assetdir="meshes" strippath="true"/>'
                r'<asset><mesh file="C:\x\a.obj"/></asset>'
            ),
            "meshes/a.obj",
        ),
        ("r.xml", mjcf('<compiler meshdir="meshes"/><include file="inner.xml"/>'), "meshes/a.obj"),
    ],
)
def test_listed_files_contain_meshes_and_their_parts(tmp_path, name, text, mesh):
    (tmp_path / "inner.urdf").write_text(urdf("meshes/a.obj"))
    (tmp_path / "inner.xml").write_text(
        "<mujocoinclude><asset><mesh file='a.obj'/></asset></mujocoinclude>"
    )
    (tmp_path / name).write_text(text)
    file = tmp_path / mesh
    file.parent.mkdir()
    file.write_text(f"mtllib a.mtl\n{SOLID}")
    file.with_suffix(".mtl").write_text("newmtl m\n")
    packages = (tmp_path / "parts",) if file.parent.name == "parts" else ()
    listed = list_model_files(tmp_path / name, packages)
    assert {tmp_path / name, file, file.with_suffix(".mtl")} <= set(listed)


def test_listed_files_contain_no_mesh_outside_folder(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "a.obj").write_text(SOLID)
    (tmp_path / "in" / "r.urdf").write_text(urdf("../a.obj"))
    assert list_model_files(tmp_path / "in" / "r.urdf", ()) == [tmp_path / "in" / "r.urdf"]
