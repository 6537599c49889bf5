"""Servos and bills: what a policy needs is measured in SI units, compared honestly, and every total adds up."""

import csv
import io
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from morph_core.catalogue import make_task
from morph_core.tasks.servos import SERVOS, ServoLimits, ServoName, per_minute
from studio.export.demand import Need, Recorder, needs_of, on_load_line, peak, percentile
from studio.export.errors import ExportError
from studio.export.materials import Line, bill_csv, bill_html, bill_of_materials, total
from studio.export.servos import ServoTable, check_servo, servo_html, servo_table, servo_text, verdict
from studio.robots.chooser import robot_of

MEASURED = arrays.arrays(float, st.integers(1, 200), elements=st.floats(-1e3, 1e3, allow_subnormal=False))


@given(MEASURED)
def test_the_percentile_is_the_smallest_size_that_95_per_cent_do_not_exceed(values: np.ndarray) -> None:
    size, found = np.abs(values), percentile(values)
    assert found in size
    assert (size <= found).mean() >= 0.95
    assert (size < found).mean() < 0.95
    assert found <= peak(values) == size.max()


@given(MEASURED)
def test_peak_and_percentile_scale_with_the_unit(values: np.ndarray) -> None:
    for statistic in (peak, percentile):
        assert statistic(1000 * values) == pytest.approx(1000 * statistic(values))  # N m as mN m
        assert statistic(-values) == statistic(values)


@given(st.floats(0.1, 20), st.floats(1, 20), st.floats(0, 1))
def test_a_motor_on_its_line_from_stall_to_no_load_uses_all_of_itself(stall: float, fast: float, share: float) -> None:
    force, speed = np.array([share * stall]), np.array([(1 - share) * fast])
    driving, braking = on_load_line(force, speed, stall, fast), on_load_line(-force, speed, stall, fast)
    assert driving == pytest.approx(1, abs=1e-9)
    assert braking == pytest.approx(max(share, 1 - share))
    assert np.array_equal(on_load_line(-force, -speed, stall, fast), driving)


def need(torque: float, speed: float, together: bool = False) -> Need:
    """Return a need of 200 instants: a tenth of them with this torque (N m), a tenth, or the same, at this speed."""
    force, turn = np.zeros(200), np.zeros(200)
    force[:20], turn[(0 if together else 20) :][:20] = torque, speed
    return Need("joint", False, force, turn)


def compared(*needs: Need, wanted: ServoName | None = None, limits: ServoLimits = "none") -> ServoTable:
    return servo_table(needs, [], 4, wanted, limits, "nothing assumed")


def test_half_a_newton_metre_is_within_the_smallest_dynamixel_and_not_within_an_mg90s() -> None:
    (fits,), (weak,) = (compared(need(0.5, 1), wanted=name).joints for name in ("XL330-M288", "MG90S"))
    assert fits.faults == []
    assert "peak torque" in weak.faults
    assert (weak.torque_peak, weak.torque_95, weak.unit) == (0.5, 0.5, "N m")


def test_a_hundred_turns_a_minute_are_within_the_fast_servo_and_not_within_the_strong_one() -> None:
    (fast,), (strong,) = (
        compared(need(0.1, per_minute(100)), wanted=name).joints for name in ("XL330-M288", "XM430-W350")
    )
    assert fast.faults == []  # 103 rev/min
    assert strong.faults == ["peak speed", "torque at speed"]  # 46 rev/min


def test_a_torque_that_equals_the_limit_suffices_and_a_little_more_does_not() -> None:
    stall = SERVOS["XL430-W250"].stall_torque
    for factor, faults in ((1.0, []), (1 + 1e-6, ["peak torque", "torque at speed"])):
        (row,) = compared(need(factor * stall, 0), wanted="XL430-W250").joints
        assert row.faults == faults


def test_full_torque_at_full_speed_is_more_than_a_servo_has() -> None:
    sheet = SERVOS["XL430-W250"]
    for together, faults in ((False, []), (True, ["torque at speed"])):
        (row,) = compared(need(sheet.stall_torque, sheet.no_load_speed, together), wanted="XL430-W250").joints
        assert row.faults == faults


def test_a_peak_of_one_instant_is_a_fault_though_the_percentile_is_nothing() -> None:
    sheet, once = SERVOS["XL430-W250"], np.eye(1, 200)[0]
    for torque, speed, fault in (
        (1.01 * sheet.stall_torque, 0, "peak torque"),
        (0, 1.01 * sheet.no_load_speed, "peak speed"),
    ):
        table = compared(Need("joint", False, torque * once, speed * once), wanted="XL430-W250")
        (row,) = table.joints
        assert (row.faults, row.torque_95, row.speed_95) == ([fault], 0, 0)
        assert [c.suffices_for for c in table.servos if c.name == "XL430-W250"] == [0]


def test_a_torque_above_the_rated_one_is_said_where_that_is_known() -> None:
    (row,) = compared(need(0.3, 0), wanted="XL430-W250").joints  # rated 0.28 N m
    assert row.above_rated
    (row,) = compared(need(0.5, 0), wanted="XL330-M288").joints  # no rated torque is known
    assert not row.above_rated


@pytest.mark.parametrize(
    ("torque", "speed", "servo"),
    [(0.1, 3, "MG90S"), (0.9, 3, "MG996R"), (2.0, 3, "STS3215"), (4.5, 3, "STS3250"), (9.0, 2, "XM540-W270")],
)
def test_the_cheapest_servo_that_suffices_is_chosen(torque: float, speed: float, servo: str) -> None:
    table = compared(need(torque, speed), need(0.01, 0.01))
    assert (table.servo, table.suffices) == (servo, True)
    assert f"{servo} suffices for every joint" in verdict(table)


def test_where_none_suffices_the_one_that_comes_nearest_is_compared() -> None:
    table = compared(need(50, 1), need(0.1, 1))
    assert table.servo == "XM540-W270"
    assert verdict(table).startswith("XM540-W270 suffices for 1 of 2 joints (none of the table suffices")
    assert "does not suffice: peak torque" in servo_text(table)


def test_the_servo_that_was_asked_for_goes_before_the_one_that_limited_the_training() -> None:
    weak = need(0.1, 1)
    assert compared(weak, limits="XL430-W250").servo == "XL430-W250"
    assert compared(weak, limits="XL430-W250", wanted="AX-12A").servo == "AX-12A"


def test_a_row_that_does_not_suffice_is_red_and_says_why() -> None:
    page = servo_html(compared(need(1.45, 0), need(0.1, 0), wanted="XL430-W250"))
    red, plain = re.findall(r'<tr style="(.*?)">', page)
    assert "220,38,38" in red
    assert plain == ""
    assert "does not suffice: peak torque, torque at speed" in page
    assert 'src="http' not in page
    assert "1.40" in page  # the servo's own


@pytest.mark.parametrize("name", ["xm430-w350", "XM430-W350"])
def test_a_servo_is_found_whatever_the_case(name: str) -> None:
    assert check_servo(name, make_task("pen_press")) == "XM430-W350"


@pytest.mark.parametrize(
    ("name", "near"),
    [("xl430", "XL430-W250"), ("xm43", "XM430-W350"), ("mg99", "MG996R"), ("\u00e9" * 99, None), ("", None)],
)
def test_another_servo_is_refused_with_the_nearest_name_and_the_list(name: str, near: str | None) -> None:
    with pytest.raises(ExportError, match="choose from: MG90S, MG996R, STS3215") as refused:
        check_servo(name, make_task("pen_press"))
    assert (f"(did you mean {near}?)" in str(refused.value)) is (near is not None)
    assert len(str(refused.value)) < 250


def test_no_servo_is_compared_where_torques_are_not_simulated() -> None:
    with pytest.raises(ExportError, match="reacher: the torques of its joints are not simulated"):
        check_servo("MG90S", make_task("reacher"))


def test_needs_are_of_the_joints_and_episodes_that_count() -> None:
    task = make_task("pen_press")
    model = task.scene(task.design_space.initial).compile()
    recorder = Recorder()
    for step in range(3):
        forces = np.arange(2 * model.nu, dtype=float).reshape(2, model.nu) + 100 * step
        recorder(np.arange(2 * model.nv, dtype=float).reshape(2, model.nv) - 100 * step, forces)
    assert needs_of(recorder, model, ["palm"]) == []  # nothing counts yet
    recorder.kept = np.array([False, True])
    palm, last = needs_of(recorder, model, ["palm", "finger_4_distal"])
    assert (palm.slides, last.slides) == (True, False)
    assert palm.force.tolist() == [model.nu, model.nu + 100, model.nu + 200]
    assert last.force.tolist() == [2 * model.nu - 1, 2 * model.nu + 99, 2 * model.nu + 199]
    assert last.speed.tolist() == [model.nv + 8, model.nv - 92, model.nv - 192]


LINES = st.lists(
    st.builds(
        Line, item=st.sampled_from(("pin", "servo", "palm")), quantity=st.integers(0, 50),
        mass=st.none() | st.floats(0, 10),
        price=st.none() | st.tuples(st.integers(0, 100), st.integers(100, 500)),
    ), max_size=8,
)  # fmt: skip


@settings(max_examples=50)
@given(LINES)
def test_totals_add_up_what_is_known(lines: list[Line]) -> None:
    everything = total(lines)
    assert everything.quantity == sum(line.quantity for line in lines)
    assert everything.mass == pytest.approx(sum(line.quantity * (line.mass or 0) for line in lines))
    priced = [(line.quantity, line.price) for line in lines if line.price]
    assert everything.price == (
        (sum(n * p[0] for n, p in priced), sum(n * p[1] for n, p in priced)) if priced else None
    )
    for line in lines:
        assert line.mass is not None or line.item in everything.note
    assert f"<th>{everything.item}<" in bill_html(lines)


def rows_of(chosen: ServoName | None, **options: object) -> dict[str, dict[str, str]]:
    """Return the lines of BOM.csv of the initial pen hand by their items."""
    task = make_task("pen_press", options)
    phi, robot = task.design_space.initial, robot_of(task)
    content = bill_csv(bill_of_materials(robot, phi, robot.parts(phi), chosen))
    return {row["item"]: row for row in csv.DictReader(io.StringIO(content.decode()))}


def test_a_bill_of_materials_has_servos_screws_pins_tendon_prints_and_totals() -> None:
    rows = rows_of("XM430-W350")
    servo = rows["servo XM430-W350"]
    assert [servo[key] for key in ("quantity", "mass_g_each", "mass_g", "size_mm", "price_usd_each", "price_usd")] == [
        "8", "82.00", "656.00", "28.5 x 46.5 x 34", "270-310", "2160-2480",
    ]  # fmt: skip
    pin = rows["dowel pin 4 x 28 mm"]  # of steel, 7850 kg/m^3
    assert (pin["quantity"], pin["mass_g_each"]) == ("8", "2.76")
    assert rows["set of mounting screws"]["quantity"] == "8"
    assert "at least 1.92 m" in rows["tendon"]["note"]  # twice 4 x (.06 + .06 + .12) m
    assert "servo or tendon drive" not in rows
    printed = [row for row in rows.values() if row["file"]]
    weighed = sum(float(row["mass_g"]) for row in rows.values() if row["mass_g"] and row["item"] != "total")
    assert len(printed) == 3  # palm, proximal and distal links
    assert float(rows["total"]["mass_g"]) == pytest.approx(weighed, abs=0.05)
    assert rows["total"]["price_usd"] == "2160-2480"
    assert "without the mass of: bolt M6 x 20, set of mounting screws, tendon" in rows["total"]["note"]


def test_pockets_take_the_servos_that_they_are_drawn_for() -> None:
    rows = rows_of("MG90S", servo="mg90s")
    assert "4 in the palm's pockets" in rows["servo MG90S"]["note"]
    assert rows["self-tapping screw for a pilot hole of 1.7 x 8 mm"]["quantity"] == "8"
    assert rows["set of mounting screws"]["quantity"] == "4"
    assert "self-tapping screw for a pilot hole of 1.7 x 8 mm" not in rows_of("STS3215", servo="mg90s")
    assert rows_of(None, servo="mg90s")["servo MG90S"]["quantity"] == "4"
    assert rows_of(None)["servo or tendon drive"]["quantity"] == "8"
