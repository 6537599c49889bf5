"""Whether real servos can do what a policy needs: a table for each joint, and which servo suffices."""

import math
from collections.abc import Sequence
from html import escape

import msgspec
import numpy as np

from morph_core.catalogue import make_task
from morph_core.config import guess
from morph_core.history import History
from morph_core.task import Task
from morph_core.tasks.servos import SERVOS, DataSheet, ServoLimits, ServoName
from studio.export.demand import SHARE, Need, Recorder, needs_of, on_load_line, peak, percentile
from studio.export.errors import ExportError
from studio.export.servo_plot import Bar, servo_plot
from studio.robots.chooser import robot_of

FILE = "servos.json"
_RED, _AMBER = "background:rgba(220,38,38,.22)", "background:rgba(217,119,6,.2)"
_ROUNDING = 1e-9
"""Share by which a torque may exceed a limit: one that was simulated equals it."""


class Row(msgspec.Struct, frozen=True):
    """What one joint needs: sizes, over all episodes and instants, in N m and rad/s, or in N and m/s if it slides."""

    joint: str
    unit: str
    """Unit of the torques: "N m", or "N" of a joint that slides."""
    torque_peak: float
    torque_95: float
    speed_peak: float
    speed_95: float
    load_line_95: float | None = None
    """Share of what the servo can do at the speed of the moment: 1 is its line from stall torque to no-load speed."""
    faults: list[str] = []
    """Reasons why the servo does not suffice; none where it does."""
    above_rated: bool = False
    """Whether torque_95 is more than the servo is rated for in steady work, where that is known."""


class Candidate(msgspec.Struct, frozen=True):
    """A servo of the table, and for how many joints it suffices."""

    name: str
    maker: str
    voltage: float
    stall_torque: float
    rated_torque: float | None
    no_load_speed: float
    mass: float
    size: tuple[float, float, float]
    price: tuple[int, int]
    source: str
    price_source: str
    suffices_for: int


class ServoTable(msgspec.Struct, frozen=True):
    """What a policy needs beside what a servo has: servos.json of a bundle; SI units, prices in USD."""

    servo: ServoName
    chosen: str
    """Reason why it is this servo."""
    episodes: int
    instants: int
    """Number of instants of all episodes, one for each step of the physics, that the figures are taken from."""
    assumed: str
    joints: list[Row]
    others: list[Row]
    """Joints that are moved from outside, without a servo."""
    servos: list[Candidate]

    @property
    def suffices(self) -> bool:
        """Whether the servo suffices for every joint."""
        return not any(row.faults for row in self.joints)

    @property
    def sheet(self) -> DataSheet:
        """Data sheet of the servo."""
        return SERVOS[self.servo]


def takes_servos(history: History) -> bool:
    """Tell whether servos can be compared with what the joints of a run's task need."""
    try:
        task = make_task(history.record.task, history.record.task_options)
    except (ValueError, TypeError):  # a task that is not installed here
        return False
    return bool(robot_of(task).servo_joints)


def check_servo(name: str, task: Task) -> ServoName:
    """Return the name of a servo; raise ExportError with what is allowed, and the nearest name."""
    if not robot_of(task).servo_joints:
        raise ExportError(f"no servo can be compared with {task.name}: the torques of its joints are not simulated")
    for known in SERVOS:
        if known.lower() == name.lower():
            return known
    raise ExportError(f'unknown servo "{name[:40]}"{guess(name[:40], SERVOS)}; choose from: {", ".join(SERVOS)}')


def compared_servos(recorder: Recorder, task: Task, phi: np.ndarray, wanted: ServoName | None) -> ServoTable | None:
    """Return what was recorded of a policy on design phi (d,) beside a servo, `wanted` or chosen; None without any."""
    robot = robot_of(task)
    model = task.scene(phi).compile()
    needs = needs_of(recorder, model, robot.servo_joints)
    if not needs:
        return None
    driven = [model.joint(j).name for j in model.actuator_trnid[:, 0]]
    others = needs_of(recorder, model, [name for name in driven if name not in robot.servo_joints])
    return servo_table(needs, others, int(recorder.kept.sum()), wanted, robot.servo_limits, robot.about_servos)


def servo_table(
    needs: Sequence[Need],
    others: Sequence[Need],
    episodes: int,
    wanted: ServoName | None,
    limits: ServoLimits,
    assumed: str,
) -> ServoTable:
    """Compare what the joints need with a servo: the one that is `wanted`, else the one within whose `limits` the
    policy was trained ("none" for none), else the cheapest that suffices, else the one that comes nearest.

    `others` are needs of joints that no servo moves.
    """
    plain = [(_row(need), need) for need in needs]
    enough: dict[ServoName, int] = {
        name: sum(_suffices(row, need, sheet) for row, need in plain) for name, sheet in SERVOS.items()
    }
    full: list[ServoName] = [name for name in SERVOS if enough[name] == len(needs)]
    servo: ServoName = max(SERVOS, key=lambda name: (enough[name], SERVOS[name].stall_torque))
    chosen = "none of the table suffices; this one comes nearest"
    if wanted is not None:
        servo, chosen = wanted, "as asked"
    elif limits != "none":
        servo, chosen = limits, "its limits were those of the training"
    elif full:
        servo, chosen = full[0], "the cheapest of those that suffice"
    return ServoTable(
        servo=servo,
        chosen=chosen,
        episodes=episodes,
        instants=len(needs[0].force),
        assumed=assumed,
        joints=[_beside(row, need, SERVOS[servo]) for row, need in plain],
        others=[_row(need) for need in others],
        servos=[_candidate(name, sheet, enough[name]) for name, sheet in SERVOS.items()],
    )


def _row(need: Need) -> Row:
    """Return what a joint needs, without a servo."""
    return Row(
        joint=need.joint,
        unit="N" if need.slides else "N m",
        torque_peak=peak(need.force),
        torque_95=percentile(need.force),
        speed_peak=peak(need.speed),
        speed_95=percentile(need.speed),
    )


def _suffices(row: Row, need: Need, sheet: DataSheet) -> bool:
    """Tell whether a servo can do what a joint needs; its load line takes long, and is not asked where a peak fails."""
    return not _peak_faults(row, sheet) and not _is_over(_load_line(need, sheet), 1.0)


def _beside(row: Row, need: Need, sheet: DataSheet) -> Row:
    """Return what a joint needs beside what a servo has."""
    line = _load_line(need, sheet)
    faults = _peak_faults(row, sheet) + ["torque at speed"] * _is_over(line, 1.0)
    strained = sheet.rated_torque is not None and row.torque_95 > sheet.rated_torque
    return msgspec.structs.replace(row, load_line_95=line, faults=faults, above_rated=strained)


def _load_line(need: Need, sheet: DataSheet) -> float:
    return percentile(on_load_line(need.force, need.speed, sheet.stall_torque, sheet.no_load_speed))


def _peak_faults(row: Row, sheet: DataSheet) -> list[str]:
    """Return which peaks of a joint are above what a servo has."""
    peaks = (("peak torque", row.torque_peak, sheet.stall_torque), ("peak speed", row.speed_peak, sheet.no_load_speed))
    return [fault for fault, need_of, limit in peaks if _is_over(need_of, limit)]


def _is_over(need_of: float, limit: float) -> bool:
    return need_of > limit * (1 + _ROUNDING)


def _candidate(name: str, sheet: DataSheet, suffices_for: int) -> Candidate:
    return Candidate(
        name, sheet.maker, sheet.voltage, sheet.stall_torque, sheet.rated_torque, sheet.no_load_speed, sheet.mass,
        sheet.size, sheet.price, sheet.source, sheet.price_source, suffices_for,
    )  # fmt: skip


def verdict(table: ServoTable) -> str:
    """Return in a sentence whether the servo suffices."""
    enough = sum(not row.faults for row in table.joints)
    said = "suffices for every joint" if table.suffices else f"suffices for {enough} of {len(table.joints)} joints"
    return f"{table.servo} {said} ({table.chosen}; {table.episodes} episodes)"


def _said(row: Row) -> str:
    if row.faults:
        return f"does not suffice: {', '.join(row.faults)}"
    return "suffices, beyond its rated torque" if row.above_rated else "suffices"


def servo_text(table: ServoTable) -> str:
    """Return the table as plain text."""
    sheet = table.sheet
    head = ("joint", "torque, peak", "95 %", "stall", "speed, peak", "95 %", "no-load", "load line, 95 %", "")
    lines: list[tuple[str, ...]] = [head]
    for row in table.joints:
        lines.append((
            row.joint, f"{row.torque_peak:.2f} N m", f"{row.torque_95:.2f}", f"{sheet.stall_torque:.2f}",
            f"{row.speed_peak:.2f} rad/s", f"{row.speed_95:.2f}", f"{sheet.no_load_speed:.2f}",
            f"{row.load_line_95:.0%}", _said(row),
        ))  # fmt: skip
    for row in table.others:
        lines.append((
            row.joint, f"{row.torque_peak:.1f} {row.unit}", f"{row.torque_95:.1f}", "", f"{row.speed_peak:.2f} m/s",
            f"{row.speed_95:.2f}", "", "", "moved from outside, by no servo",
        ))  # fmt: skip
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    drawn = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines]
    return "\n".join([verdict(table), "", *drawn, "", table.assumed, ""])


def servo_html(table: ServoTable) -> str:
    """Return the section of report.html: the joints beside the servo, the other servos, and what is assumed."""
    sheet = table.sheet
    rows = "".join(
        f'<tr style="{_RED if row.faults else _AMBER if row.above_rated else ""}"><td>{escape(row.joint)}'
        f"<td class=n>{row.torque_peak:.2f}<td class=n>{row.torque_95:.2f}<td class=n>{sheet.stall_torque:.2f}"
        f"<td class=n>{row.speed_peak:.2f}<td class=n>{row.speed_95:.2f}<td class=n>{sheet.no_load_speed:.2f}"
        f"<td class=n>{f'{row.load_line_95:.0%}'.replace('%', '&nbsp;%')}<td>{_said(row)}"
        for row in table.joints
    )
    moved = "".join(
        f"<li>{escape(row.joint)}: {row.torque_peak:.1f} {row.unit} and {row.speed_peak:.2f} m/s at the peak, "
        f"{row.torque_95:.1f} {row.unit} and {row.speed_95:.2f} m/s in 95&nbsp;% of the time"
        for row in table.others
    )
    outside = f"<p>Moved from outside, by no servo:<ul>{moved}</ul>" if moved else ""
    others = "".join(_candidate_row(other, len(table.joints)) for other in table.servos)
    read = "".join(
        f"<br>{escape(other.name)}: {escape(other.source)}; prices: {escape(other.price_source)}"
        for other in table.servos
    )
    return f"""<p>{escape(verdict(table))}. {escape(_about(sheet))}
<div class=plots>{_plots(table)}</div>
<p class="dim small">Bars: {SHARE:g}&nbsp;% of the time. Pale: the peak. Red: the servo does not suffice.
<table><thead><tr><th><th colspan=3 class=n>torque, N&nbsp;m<th colspan=3 class=n>speed, rad/s
<th class=n>load line<th></tr>
<tr><th>joint<th class=n>peak<th class=n>{SHARE:g}&nbsp;%<th class=n>servo, stall
<th class=n>peak<th class=n>{SHARE:g}&nbsp;%<th class=n>servo, no load
<th class=n>{SHARE:g}&nbsp;%<th>verdict</tr></thead>{rows}</table>
<p class=dim>Sizes over {table.instants:,} instants of {table.episodes} episodes. Load line: the share that is used of
what a DC motor can do at the speed of the moment, on a line from stall torque to no-load speed. Red: the servo does not
suffice. Amber: the torque is above the rated torque, for steady work, in more than {100 - SHARE:g}&nbsp;% of the time.
{outside}
<p>{escape(table.assumed)}
<details><summary>All servos of the table</summary>
<table><thead><tr><th>servo<th class=n>V<th class=n>stall N&nbsp;m<th class=n>rated N&nbsp;m<th class=n>no load rad/s
<th class=n>g<th>mm<th class=n>USD each<th>suffices for</tr></thead>{others}</table>
<p class=dim>Read at{read}</details>
"""


def _plots(table: ServoTable) -> str:
    """Return torques and speeds of the joints as bars, each beside what the servo has."""
    sheet = table.sheet
    torques = [Bar(row.joint, row.torque_peak, row.torque_95, not row.faults) for row in table.joints]
    speeds = [Bar(row.joint, row.speed_peak, row.speed_95, not row.faults) for row in table.joints]
    rated = [("rated", sheet.rated_torque)] if sheet.rated_torque is not None else []
    stall, free = ("stall", sheet.stall_torque), ("no load", sheet.no_load_speed)
    return servo_plot("torque", "N m", torques, [stall, *rated]) + servo_plot("speed", "rad/s", speeds, [free])


def _about(sheet: DataSheet) -> str:
    rated = f", rated {sheet.rated_torque:.2f} N m" if sheet.rated_torque is not None else ""
    return (
        f"{sheet.maker}, at {sheet.voltage:g} V: stall torque {sheet.stall_torque:.2f} N m{rated}, no-load speed "
        f"{sheet.no_load_speed:.2f} rad/s ({sheet.no_load_speed * 30 / math.pi:.0f} rev/min), "
        f"{1000 * sheet.mass:.4g} g; {sheet.source}."
    )


def _candidate_row(servo: Candidate, joints: int) -> str:
    rated = "" if servo.rated_torque is None else f"{servo.rated_torque:.2f}"
    size = "&nbsp;&times;&nbsp;".join(f"{1000 * side:.4g}" for side in servo.size)
    return (
        f"<tr><td>{escape(servo.name)} ({escape(servo.maker)})<td class=n>{servo.voltage:g}"
        f"<td class=n>{servo.stall_torque:.2f}<td class=n>{rated}<td class=n>{servo.no_load_speed:.2f}"
        f"<td class=n>{1000 * servo.mass:.4g}<td>{size}<td class=n>{servo.price[0]:g}&ndash;{servo.price[1]:g}"
        f"<td>{servo.suffices_for} of {joints} joints"
    )
