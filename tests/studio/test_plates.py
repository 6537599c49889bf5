"""The prints of any design: on their widest side, inside the printer, apart, whole, and sliced without complaint."""

import csv
import io
import itertools
import math
import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from manifold3d import Manifold, Mesh64

from morph_core.catalogue import make_task
from morph_core.task import Task
from studio.export.coupon import NAME as COUPON
from studio.export.coupon import STEPS, coupon
from studio.export.errors import ExportError
from studio.export.gauge import bore, fits_of, overhang, thinnest_wall
from studio.export.layout import GAP, arrange
from studio.export.pieces import pieces_of
from studio.export.plate_picture import plate_picture
from studio.export.plates import PIECES, Prints, dowels_bought, note_of, plan_prints, plate_title, print_files
from studio.export.printers import DEFAULT, PRINTERS, Printer, printer_of
from studio.robots import geometry
from studio.robots.chooser import robot_of
from studio.robots.parts import Part
from tests.counts import DESIGNS

HANDS = ("pen_press", "mouse_click")
LAYER = 0.2  # mm


def prints_of(task: Task, phi: np.ndarray, printer: Printer = DEFAULT) -> Prints:
    return plan_prints(robot_of(task).parts(phi), printer, task.spec(phi).compile())


def designs(task: Task) -> st.SearchStrategy[np.ndarray]:
    """Return designs (d,) in the box, often on its faces, that can be assembled."""
    space = task.design_space
    entries = [
        st.one_of(st.sampled_from([lo, hi]), st.floats(lo, hi))
        for lo, hi in zip(space.lo.tolist(), space.hi.tolist(), strict=True)
    ]
    return st.tuples(*entries).map(np.array).filter(task.buildable)


def corner(task: Task, length: float) -> np.ndarray:
    """Return the design whose links all have one length in m."""
    space = task.design_space
    return np.where([p.unit == "m" for p in space.parameters], length, space.initial)


def link(name: str, length: float) -> Part:
    """Return one finger's outer link of a length in mm."""
    task = make_task("pen_press")
    [drawn] = [p for p in robot_of(task).parts(corner(task, length / 1e3)) if p.name == "finger_1_distal"]
    return Part(name, (name,), drawn.vertices, drawn.faces)


def block(size: tuple[float, float, float], copies: int = 1) -> Part:
    box = trimesh.creation.box(size)
    return Part("block", tuple(f"block_{i}" for i in range(copies)), np.asarray(box.vertices), np.asarray(box.faces))


def bodies_of(content: bytes) -> list[tuple[str, Manifold]]:
    """Return what a 3MF puts on the bed as trimesh reads it, each watertight."""
    scene = trimesh.load_scene(io.BytesIO(content), file_type="3mf")
    found = []
    for node in scene.graph.nodes_geometry:
        pose, name = scene.graph[node]
        mesh = scene.geometry[name]
        assert mesh.is_watertight
        assert mesh.is_volume
        solid = Manifold(Mesh64(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.uint64))).transform(pose[:3])
        assert len(solid.decompose()) == 1
        found.append((name, solid))
    return found


def sides(body: Manifold) -> list[float]:
    """Return the area of the layer next to each of six sides, in mm^2; that on which it lies comes first."""
    turns = [(0, 0, 0), (180, 0, 0), (90, 0, 0), (-90, 0, 0), (0, 90, 0), (0, -90, 0)]
    turned = [body.rotate(turn) for turn in turns]
    return [t.slice(t.bounding_box()[2] + LAYER).area() for t in turned]


def check_plates_of(prints: Prints) -> None:
    """Assert what holds of the files of every design."""
    files = print_files(prints)
    assert prints.problems == {}
    on_plates: Counter[str] = Counter()
    for path, content in files.items():
        if not path.endswith(".3mf"):
            continue
        bodies = bodies_of(content)
        for name, body in bodies:
            low, high = np.array(body.bounding_box()).reshape(2, 3)
            assert low[2] == pytest.approx(0, abs=1e-9), name
            assert low.min() > -1e-9
            if path.startswith("plates/"):
                assert (high <= np.array(prints.printer.size) + 1e-9).all(), name
        shadows = [body.project().offset(GAP / 2 - 0.01) for _, body in bodies]
        for one, other in itertools.combinations(shadows, 2):
            assert (one ^ other).area() == pytest.approx(0, abs=1e-9), path
        if path.startswith("plates/"):
            on_plates.update(name for name, _ in bodies)
    for each in prints.parts.values():
        for piece in each.pieces:
            assert on_plates.pop(piece.name) == piece.copies
            [down, *others] = sides(piece.laid)
            assert down >= max(others) * (1 - 1e-6), piece.name
    assert on_plates == {COUPON: 1}
    [down, *others] = sides(coupon(4.0).laid)
    assert down >= max(others)


def test_a_hand_of_any_lengths_lies_on_plates() -> None:
    task = make_task("pen_press")

    @given(phi=designs(task), printer=st.sampled_from([DEFAULT, PRINTERS["prusa_mini"], PRINTERS["prusa_mk4s"]]))
    @example(phi=corner(task, 0.4), printer=DEFAULT)
    @example(phi=corner(task, 0.28), printer=DEFAULT)  # across the bed
    @settings(max_examples=1, deadline=None)
    def lies(phi: np.ndarray, printer: Printer) -> None:
        check_plates_of(prints_of(task, phi, printer))

    lies()


@pytest.mark.slow
@pytest.mark.parametrize("name", HANDS)
def test_many_hands_lie_on_plates(name: str) -> None:
    task = make_task(name)

    @given(phi=designs(task), printer=st.sampled_from([DEFAULT, *PRINTERS.values()]))
    @example(phi=corner(task, 0.02), printer=DEFAULT)
    @settings(max_examples=DESIGNS, deadline=None)
    def lies(phi: np.ndarray, printer: Printer) -> None:
        check_plates_of(prints_of(task, phi, printer))

    lies()


def test_an_upright_finger_is_laid_down_by_the_transform_and_its_mesh_stays_in_the_links_frame() -> None:
    part = link("finger", 120.0)
    [piece] = pieces_of(part, DEFAULT).pieces
    files = print_files(plan_prints([part], DEFAULT))
    scene = trimesh.load_scene(io.BytesIO(files["3mf/finger.3mf"]), file_type="3mf")
    np.testing.assert_allclose(scene.geometry["finger"].bounds, [part.vertices.min(0), part.vertices.max(0)])
    assert piece.first_layer > 1000  # mm^2; upright it would stand on its round tip
    np.testing.assert_allclose(piece.size, [150.0, 29.2, 29.2], atol=0.1)


def test_copies_fill_a_plate_before_the_next_one_is_begun() -> None:
    room = DEFAULT.room[0]
    for count, plates in ((4, 1), (5, 2)):
        prints = plan_prints([block((room / 2 - GAP / 2, room / 2 - GAP / 2, 5.0), count)], DEFAULT)
        assert [len(plate.items) for plate in prints.plates] == ([4, 1] if plates == 2 else [4])


# --- what is too long ---


def test_a_link_that_is_too_long_is_cut_and_dowelled() -> None:
    part = link("finger", 400.0)
    made = pieces_of(part, DEFAULT)
    assert [piece.name for piece in made.pieces] == ["finger_1of2", "finger_2of2"]
    assert made.dowel == (8.0, 40.0)
    whole, (one, other) = part.solid, (piece.solid for piece in made.pieces)
    assert (one ^ other).volume() == pytest.approx(0, abs=1e-9)
    holes = [hole for hole in (whole - one - other).decompose() if hole.volume() > 1.0]  # others are rounded edges
    assert len(holes) == 2
    for hole in holes:
        assert hole.volume() == pytest.approx(math.pi * 4.1**2 * 41.0, rel=0.01)
        middle = np.array(hole.bounding_box()).reshape(2, 3).mean(0)
        dowel = Manifold.cylinder(40.0, 4.0, circular_segments=48, center=True).translate(middle)
        assert (dowel ^ (one + other)).volume() == pytest.approx(0, abs=1e-9)
        around = Manifold.cylinder(41.0, 4.1 + 2.9, circular_segments=48, center=True)
        assert (around.translate(middle) - whole).volume() < 1e-6  # material round it
    np.testing.assert_allclose([piece.size[0] for piece in made.pieces], part.size[2] / 2)


def test_a_link_lies_across_the_bed_before_it_is_cut() -> None:
    room = DEFAULT.room[0]
    assert DEFAULT.longest(29.2) == pytest.approx(math.sqrt(2) * room - 29.2, rel=1e-3)
    assert len(pieces_of(link("finger", 275.0), DEFAULT).pieces) == 1
    assert len(pieces_of(link("finger", 290.0), DEFAULT).pieces) == 2
    bars = [pieces_of(block((length, 20.0, 5.0)), DEFAULT).pieces[0] for length in (200.0, 245.0)]
    [plate] = arrange(bars, DEFAULT)  # the shorter one beside it, though it needs no slant
    assert len(plate.items) == 2


def test_more_pieces_than_hold_together_are_refused_with_the_length_and_what_is_allowed() -> None:
    task = make_task("reacher")
    prints = prints_of(task, np.array([3.0, 0.2, 0.2, 0.2, 0.2]))
    assert list(prints.problems) == ["link_1"]
    assert prints.problems["link_1"].startswith("link_1 is 3")
    assert "mm of length are allowed in one piece" in prints.problems["link_1"]
    assert "link_1" not in {item.piece.part for plate in prints.plates for item in plate.items}
    files = print_files(prints)
    [(_, body)] = bodies_of(files["3mf/link_1.3mf"])  # whole, and lying
    assert min(body.bounding_box()[:3]) > -1e-9
    assert body.bounding_box()[5] < 125.0
    rows = {row["piece"]: row for row in csv.DictReader(io.StringIO(files[PIECES].decode()))}
    assert rows["link_1"]["problem"] == prints.problems["link_1"]
    assert note_of(prints, "link_1") == prints.problems["link_1"]
    assert rows["link_2_1of2"]["problem"] == ""


def test_a_palm_is_not_cut() -> None:
    task = make_task("pen_press")
    part = robot_of(task).parts(task.design_space.initial)[0]
    with pytest.raises(
        ValueError, match=r"palm is 149 x 149 x 41 mm as it lies, .* a bed of 165 x 165 mm or more is ne"
    ):
        pieces_of(part, Printer("120x120x120", (120.0, 120.0, 120.0)))
    with pytest.raises(ValueError, match="20 mm of height are allowed"):
        pieces_of(part, Printer("200x200x20", (200.0, 200.0, 20.0)))


def test_dowels_are_bought() -> None:
    task = make_task("pen_press")
    prints = prints_of(task, corner(task, 0.4))
    fingers = len(task.design_space.parameters) // 2
    [line] = dowels_bought(prints)
    assert line[:2] == ("dowel pin 8 x 40 mm", 2 * 2 * fingers)
    assert "2 pieces, with 2 dowels" in note_of(prints, "finger_1_distal")
    assert note_of(prints, "palm") == ""


@given(length=st.floats(60.0, 400.0), wall=st.floats(0.5, 30.0))
@settings(max_examples=20, deadline=None)
def test_a_bar_is_cut_only_where_dowels_find_room(length: float, wall: float) -> None:
    printer = Printer("100x100x100", (100.0, 100.0, 100.0))
    try:
        made = pieces_of(block((length, wall, wall)), printer)
    except ValueError:
        assert length > printer.longest(wall)
        return
    for piece in made.pieces:
        assert printer.takes(piece.size)
    if len(made.pieces) > 1:
        assert made.dowel is not None
        assert wall >= made.dowel[0] + 6.0
        assert sum(piece.solid.volume() for piece in made.pieces) < length * wall**2


# --- which printer ---


def test_a_printer_has_a_name_or_a_size() -> None:
    assert printer_of("prusa_xl").size == (360.0, 360.0, 360.0)
    assert printer_of("300x200.5x400").size == (300.0, 200.5, 400.0)
    assert printer_of("256x256x256") == DEFAULT


@pytest.mark.parametrize(
    "word",
    [
        "",
        "prusa",
        "256",
        "256x256",
        "-1x2x3",
        "0x256x256",
        "49x256x256",
        "2001x9x9",
        "1e3x256x256",
        "nanx1x1",
        "x" * 99,
    ],
)
def test_other_printers_are_refused_with_the_list(word: str) -> None:
    with pytest.raises(
        ExportError, match=r"choose from: bambu_a1_mini.*or a size in mm such as 300x300x400"
    ) as refusal:
        printer_of(word)
    assert len(str(refusal.value)) < 350


@given(bed=st.tuples(*[st.floats(50.0, 400.0)] * 2), length=st.floats(1.0, 600.0), width=st.floats(1.0, 300.0))
def test_what_a_bed_takes_lies_on_it(bed: tuple[float, float], length: float, width: float) -> None:
    printer = Printer("", (*bed, 100.0))
    angle = printer.angle_of(length, width)
    if angle is None:
        assert length > min(printer.room) - 1e-9 or width > min(printer.room) - 1e-9
        return
    cos, sin = math.cos(angle), math.sin(angle)
    assert length * cos + width * sin <= printer.room[0] + 1e-6
    assert length * sin + width * cos <= printer.room[1] + 1e-6
    assert length <= printer.longest(width) * (1 + 1e-6)


# --- what is measured ---


def test_the_thinnest_wall_of_a_box_with_a_pocket_is_the_one_beside_the_pocket() -> None:
    pocket = Manifold.cube((10.0, 10.0, 10.0)).translate((5.0, 1.25, 5.0))
    assert thinnest_wall(Manifold.cube((20.0, 20.0, 20.0)) - pocket) == pytest.approx(1.25)
    assert thinnest_wall(Manifold.cube((20.0, 20.0, 3.0))) == pytest.approx(3.0)
    wedge = Manifold.hull_points(np.array([(0, 0, 0), (0, 9, 0), (9, 0, 0), (9, 9, 0), (0, 0, 9), (0, 9, 9)], float))
    assert thinnest_wall(wedge) == pytest.approx(9.0)  # its sharp edge is no wall; its two ends are 9 mm apart


def test_a_wall_that_is_too_thin_is_a_problem() -> None:
    prints = plan_prints([block((30.0, 20.0, 0.3))], DEFAULT)
    assert prints.problems == {"block": "block has a wall of 0.3 mm: 0.4 mm or more are allowed"}
    assert prints.plates == []


def test_what_hangs_over_is_the_underside_above_the_bed() -> None:
    table = Manifold.cube((10.0, 10.0, 10.0)) + Manifold.cube((30.0, 10.0, 2.0)).translate((0.0, 0.0, 10.0))
    assert overhang(table) == pytest.approx(200.0)
    assert overhang(Manifold.cube((10.0, 10.0, 10.0))) == 0.0
    for angle, hangs in ((44.0, False), (46.0, True)):
        lean = 10.0 * math.tan(math.radians(angle))
        leaning = Manifold.hull_points(
            np.array([(x, y, z) for x, z in ((0, 0), (9, 0), (lean, 10), (lean + 9, 10)) for y in (0.0, 9.0)])
        )
        assert (overhang(leaning) > 0) is hangs


def test_the_bore_is_as_wide_as_the_pin_that_fits_between_its_facets() -> None:
    drill = Manifold.cylinder(40.0, 3.0, circular_segments=8, center=True)
    vertices, faces = geometry.mesh(Manifold.cube((20.0, 20.0, 20.0), center=True) - drill)
    assert bore(vertices, faces, np.zeros(3), np.array([0.0, 0, 1])) == pytest.approx(6.0 * math.cos(math.pi / 8))
    assert bore(vertices, faces, np.array([1.0, 0, 5]), np.array([0.0, 0, -1])) < 4.0
    assert bore(vertices, faces, np.zeros(3), np.array([1.0, 0, 0])) == 0.0


@pytest.mark.parametrize(("name", "pin"), [("pen_press", 4.0), ("reacher", 10.0)])
def test_pins_play_in_the_link_that_turns_and_links_clear_each_other(name: str, pin: float) -> None:
    task = make_task(name)
    phi = task.design_space.initial
    fits = fits_of(task.spec(phi).compile(), robot_of(task).parts(phi))
    assert fits
    for fit in fits:
        assert fit.bores == pytest.approx((pin, pin + 0.2), abs=3e-3)  # between facets
        assert fit.play == pytest.approx(0.2, abs=3e-3)
        assert fit.gap == pytest.approx(0.3, abs=0.012)  # between facets


@pytest.mark.parametrize("pin", [4.0, 10.0])
def test_the_coupon_has_a_bore_for_each_play_level_as_it_is_printed(pin: float) -> None:
    piece = coupon(pin)
    vertices, faces = geometry.mesh(piece.laid)
    length, along, height = piece.size
    for i, play in enumerate(STEPS):
        middle = np.array([(i + 0.5) * length / len(STEPS), along / 2, height / 2])
        assert bore(vertices, faces, middle, np.array([0.0, 1, 0])) == pytest.approx(pin + play)
    assert thinnest_wall(piece.laid) == pytest.approx(1.0)  # between grooves
    top = piece.laid.slice(float(height) - 0.3)
    assert (
        len(top.decompose()) == sum(range(1, len(STEPS) + 1)) + 1
    )  # one groove beside the first bore, five at the last


# --- pictures ---


def test_a_picture_names_everything_on_the_plate_and_loads_nothing() -> None:
    task = make_task("pen_press")
    prints = prints_of(task, task.design_space.initial)
    for number, plate in enumerate(prints.plates, start=1):
        text = plate_picture(plate, plate_title(prints, number))
        assert text.count("<path") == len(plate.items)
        for item in plate.items:
            assert f">{item.piece.name}</text>" in text
        assert "256 x 256 x 256 mm" in text
        assert "http" not in text.replace("http://www.w3.org/2000/svg", "")


# --- the slicer ---


@pytest.mark.slow
@pytest.mark.parametrize("name", [*HANDS, "reacher"])
def test_the_slicer_takes_every_plate_without_a_warning(name: str, tmp_path: Path) -> None:
    if (slicer := shutil.which("prusa-slicer")) is None:
        pytest.skip("install Debian's package prusa-slicer")
    task = make_task(name)
    lengths = (0.1, 0.3, 0.4) if name in HANDS and DESIGNS >= 100 else (0.3,)
    for length in lengths:
        folder = tmp_path / f"{length:g}"
        folder.mkdir()
        for path, content in print_files(prints_of(task, corner(task, length))).items():
            if path.startswith("plates/") and path.endswith(".3mf"):
                (folder / Path(path).name).write_bytes(content)
        assert sliced(slicer, folder, DEFAULT) == [], length


def sliced(slicer: str, folder: Path, printer: Printer, *options: str) -> list[str]:
    """Slice the plates of a folder, bodies where they lie; return the lines of what the slicer says that complain."""
    x, y, z = printer.size
    said = []
    for plate in sorted(folder.glob("*.3mf")):
        done = subprocess.run(
            [
                slicer, "--loglevel=2", "--export-gcode", "--dont-arrange", f"--bed-shape=0x0,{x}x0,{x}x{y},0x{y}",
                f"--max-print-height={z}", *options, "--output", "plate.gcode", plate.name,
            ],
            cwd=folder, capture_output=True, text=True, timeout=600, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        printed = re.findall(r"^G1 X(\S+) Y(\S+) E", (folder / "plate.gcode").read_text(), re.MULTILINE)
        places = np.array(printed, float)
        assert len(places) > 300, plate
        assert (places > 0).all(), plate
        assert (places < printer.size[:2]).all(), plate
        (folder / "plate.gcode").unlink()
        said += (done.stdout + done.stderr).splitlines()
    words = ("warn", "error", "empty", "outside", "fail", "repair", "unstable")
    return [line for line in said if any(word in line.lower() for word in words)]
