"""report.html and BOM.csv: what a person who opens the bundle wants to know, on one page."""

import base64
import csv
import io
from collections.abc import Sequence
from html import escape

from morph_core.protocol import Evaluation
from studio.export.design_file import Design
from studio.export.policy import Score
from studio.export.ros import package_name
from studio.robots.parts import Part
from studio.robots.robot import Program, Robot

_STYLE = """\
body{font:15px/1.5 system-ui,sans-serif;max-width:52rem;margin:2rem auto;padding:0 1rem;color:#1c1e22;background:#fff}
h1{font-size:1.5rem;margin:0}h2{font-size:1.1rem;margin:1.6rem 0 .4rem}img{width:100%;max-width:36rem;display:block}
table{border-collapse:collapse}th,td{padding:.15rem .9rem .15rem 0;text-align:left;vertical-align:top}
td.n{text-align:right;font-variant-numeric:tabular-nums}th{border-bottom:1px solid #ccc}
pre{background:#f3f4f6;padding:.6rem;overflow-x:auto}.dim{color:#5c6370}
@media(prefers-color-scheme:dark){body{background:#16181d;color:#e6e7ea}pre{background:#22252c}.dim{color:#9aa1ad}}
"""


def bill_of_materials(parts: Sequence[Part], robot: Robot) -> bytes:
    """Return BOM.csv: what is printed, and what is bought."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["item", "quantity", "links", "file", "material", "mass_g_each", "size_mm", "note"])
    for part in parts:
        size = " x ".join(f"{s:.1f}" for s in part.size)
        note = "longer than common printers: print it in pieces" if part.size.max() > 350 else ""
        writer.writerow([
            part.name, part.quantity, " ".join(part.links), part.stl_path, f"PLA, infill {part.infill:.0%}",
            f"{1000 * part.inertial.mass:.2f}", size, note,
        ])  # fmt: skip
    writer.writerows(robot.bought(parts))
    return out.getvalue().encode()


def report(
    design: Design,
    robot: Robot,
    picture: bytes | None,
    parts: Sequence[Part],
    score: Score | None,
    recorded: Evaluation | None,
    program: Program | None,
) -> bytes:
    """Return the page; everything in it that came from a run is escaped, and nothing in it is loaded from elsewhere."""
    run = f"<p>The policy, with numpy and mujoco alone<pre>{escape(program.command)}</pre>" if program else ""
    image = (
        f'<img alt="the assembled robot" src="data:image/png;base64,{base64.b64encode(picture).decode()}">'
        if picture
        else ""
    )
    rows = "".join(
        f"<tr><td>{escape(p.name)}<td class=n>{p.value:.6g}<td>{escape(p.unit)}<td class=n>{p.initial:.6g}"
        f"<td class=n>{p.lo:.4g} &hellip; {p.hi:.4g}<td>{'' if p.locked_at is None else 'locked'}"
        for p in design.parameters
    )
    package = package_name(design.task)
    page = f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<title>{escape(design.run)}</title><style>{_STYLE}</style>
<h1>{escape(design.task)}: design of iteration {design.iteration}</h1>
<p class=dim>run {escape(design.run)}; where it comes from: provenance.json
{image}
<h2>Design &phi;</h2>
<table><tr><th>parameter<th>value<th>unit<th>initial<th>bounds<th></tr>{rows}</table>
<h2>Success</h2>{_success(score, recorded)}
{_parts(parts, robot)}
<h2>Load it</h2>
<p>MuJoCo: the robot alone, or with its task
<pre>model = mujoco.MjModel.from_xml_path("{escape(design.robot)}.xml")
model = mujoco.MjModel.from_xml_path("scene.xml")   # or drop {escape(design.robot)}.mjz on live.mujoco.org</pre>
<p>ROS 2, from an export with <code>--formats ros</code>, in a workspace
<pre>cp -r ros/{escape(package)} WORKSPACE/src/ &amp;&amp; cd WORKSPACE &amp;&amp; colcon build
ros2 launch {escape(package)} display.launch.py</pre>
<p>Gazebo
<pre>gz sdf -p {escape(design.robot)}.urdf   # what it makes of it; ros_gz_sim's create -file spawns it</pre>
<p>Drake
<pre>pydrake.multibody.parsing.Parser(plant).AddModels("{escape(design.robot)}.urdf")</pre>
<p>Isaac Sim / Isaac Lab
<pre>./isaaclab.sh -p scripts/tools/convert_urdf.py {escape(design.robot)}.urdf {escape(design.robot)}.usd --fix-base
# then set the servo gains and armatures of control.json on the joint drives</pre>
{run}
<p class=dim>Everything is compared with the simulated robot before it is offered; again at any time:
<pre>morph-studio verify THIS_BUNDLE</pre>
</html>
"""
    return page.encode()


def _success(score: Score | None, recorded: Evaluation | None) -> str:
    lines = []
    if recorded:
        milestones = "".join(f", {escape(name)} {share:.0%}" for name, share in recorded.milestones.items())
        lines.append(
            f"<p>In training, on Hw-Phy with this design: {recorded.sampled_success:.1%} with the sampled policy, "
            f"{recorded.deterministic_success:.1%} with its mean{milestones}."
        )
    if score:
        lines.append(
            f"<p>The exported policy on the exported files: {score.success:.1%} of {score.episodes} episodes "
            f"({escape(score.where)})."
        )
    return "".join(lines) or "<p>Not measured: the run holds neither an evaluation nor a policy of this design."


def _parts(parts: Sequence[Part], robot: Robot) -> str:
    if not parts:
        return ""
    rows = "".join(
        f"<tr><td>{escape(part.name)}<td class=n>{part.quantity}<td class=n>{1000 * part.inertial.mass:.1f}"
        f"<td class=n>{' &times; '.join(f'{s:.1f}' for s in part.size)}<td>{escape(', '.join(part.links))}"
        for part in parts
    )
    return f"""<h2>{"Parts to print" if robot.printed else "Parts"}</h2>
<table><tr><th>part<th>quantity<th>g each<th>mm<th>links</tr>{rows}</table>
{robot.about_parts}"""
