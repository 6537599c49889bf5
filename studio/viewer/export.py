"""The export panel: choose a design and formats, see what was checked, download; and go on from an exported design."""

import threading
from collections.abc import Callable, Sequence

import msgspec
import viser

from morph_core.history import History
from morph_core.tasks.servos import SERVOS
from studio.export.bundle import ALL_FORMATS, OPTIONAL_FORMATS, Bundle
from studio.export.design_file import DESIGN_TYPES
from studio.export.printers import CHOICES as PRINTERS
from studio.export.printers import DEFAULT
from studio.export.ros import FOLDER
from studio.export.servos import FILE, ServoTable, takes_servos, verdict
from studio.limits import LAST_ITERATION
from studio.viewer import wording
from studio.viewer.once import once

BY_NEED = "by need"
"""Word for the servo that the export chooses itself."""
CHOICES = ("best", "latest", "iteration")
HINTS = {
    "mjcf": "MuJoCo: the robot, the robot with its task, and one .mjz that live.mujoco.org opens",
    "urdf": "ROS, Isaac and others; servo gains in control.json",
    "stl": "to print, one file for each part, mm",
    "3mf": "to print, lying on the plates of a printer, with pictures of them, mm",
    "glb": "the assembly to look at, m",
    "step": "for CAD programs; needs build123d and takes half a minute",
    "ros": "a ROS 2 description package, which a launch file shows in RViz",
    "ros2_control": "servos in the URDF: transmissions, and ros2_control with mock hardware",
}
_PLACES = {
    "mjcf": (".xml", ".mjz"), "urdf": (".urdf", "control.json"), "stl": (".stl",), "3mf": (".3mf", ".svg"),
    "glb": (".glb",), "step": (".step",), "ros": (), "ros2_control": (),
}  # fmt: skip


def _is_of(name: str, path: str) -> bool:
    """Tell whether a file of a bundle belongs to a format; all of a ROS package, its meshes too, to `ros`."""
    return name == "ros" if path.startswith(f"{FOLDER}/") else path.endswith(_PLACES[name])


class ExportPanel:
    """`on_export("best", "latest" or an iteration's number, formats, servo, printer)` builds and checks a bundle; servo
    and printer are None where nothing was asked for.

    `on_import(content, client)` is handed the bytes of a design.json or of a bundle. Other ways to use the chosen
    design have their tabs in `ways`.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        *,
        on_export: Callable[[str, Sequence[str], str | None, str | None], Bundle],
        on_import: Callable[[bytes, viser.ClientHandle | None], None],
    ) -> None:
        self._on_export = on_export
        self._history: History | None = None
        self._bundle: Bundle | None = None
        self._choices = 0
        """How often something else was chosen: a bundle that was asked for before is not offered after that."""
        self._takes_servos = False
        self.note = gui.add_html("")
        self.design = gui.add_dropdown("design", CHOICES, initial_value="best")
        self.iteration = gui.add_number(
            "iteration", 0, min=0, max=LAST_ITERATION, step=1, visible=False, hint="0 is the initial design"
        )
        self.ways = gui.add_tab_group()
        with self.ways.add_tab("Files", viser.Icon.FILES):
            self.servo = gui.add_dropdown(
                "servo", (BY_NEED, *SERVOS), initial_value=BY_NEED, visible=False,
                hint="The real servo with which report.html compares what the policy needs: measured in 256 episodes; "
                "by need: the cheapest that suffices",
            )  # fmt: skip
            self.formats_folder = gui.add_folder("Formats", expand_by_default=False)
            with self.formats_folder:
                self.formats = {
                    name: gui.add_checkbox(name, name not in OPTIONAL_FORMATS, hint=HINTS[name]) for name in ALL_FORMATS
                }
                self.printer = gui.add_text("printer", DEFAULT.name, hint=f"For 3mf: {PRINTERS}")
            self.check = gui.add_button("Check and prepare", icon=viser.Icon.CHECKLIST, color="blue")
            self.notice = gui.add_html("", visible=False)
            self.download = gui.add_button("Download", icon=viser.Icon.DOWNLOAD, color="green", visible=False)
            self.result = gui.add_html("", visible=False)
            self.bring = gui.add_upload_button(
                "Go on from a design…", icon=viser.Icon.UPLOAD, mime_type=DESIGN_TYPES,
                hint="A design.json, or an exported zip: the run goes on from it",
            )  # fmt: skip
        self.design.on_update(lambda _: self._choose())
        self.iteration.on_update(lambda _: self._choose())
        self.servo.on_update(lambda _: self._choose())
        for box in self.formats.values():
            box.on_update(lambda _: self._choose())
        self.printer.on_update(lambda _: self._choose())
        self._at_work = threading.Lock()
        begin = once(lambda _: threading.Thread(target=self.submit, name="export", daemon=True).start())
        self.check.on_click(begin)
        self.download.on_click(lambda event: self.send(event.client))
        self.bring.on_upload(lambda event: on_import(event.target.value.content, event.client))
        self.clear()

    def clear(self) -> None:
        """Show no run."""
        self._history = None
        self._forget()
        self._show(False)
        self.note.content = wording.paragraph(wording.dim("no data yet: press Start"))

    def update(self, history: History) -> None:
        """Offer the designs of a run."""
        if self._history is None or self._history.folder.id != history.folder.id:
            self._forget()
            self.servo.value, self._takes_servos = BY_NEED, takes_servos(history)
        self._history = history
        self._show(True)
        best = history.best
        found = (
            f"best: iteration {best.iteration}, success {wording.percent(best.sampled_success)}"
            if best
            else "no evaluation yet: best is the latest"
        )
        self.note.content = wording.paragraph(f"{found}<br>latest: iteration {history.iteration}")

    def which(self) -> str:
        """Return what is chosen. Raise ValueError if there is no such design."""
        if self._history is None:
            raise ValueError("there is no run to export from: start or choose one")
        if self.design.value not in CHOICES:
            raise ValueError(f'no design "{self.design.value}"; choose from: {", ".join(CHOICES)}')
        which = str(self.iteration.value) if self.design.value == "iteration" else self.design.value
        self._history.design(which)
        return which

    def submit(self) -> None:
        """Build the bundle, and show what is in it and what was compared; one at a time."""
        if not self._at_work.acquire(blocking=False):
            return
        try:
            self._submit()
        finally:
            self._at_work.release()

    def _submit(self) -> None:
        self._forget()
        asked = self._choices
        try:
            which = self.which()
        except ValueError as error:
            self.tell(str(error))
            return
        self.tell("building the files and comparing them: this takes up to half a minute…", wording.BLUE)
        self.check.disabled = True
        try:
            servo = None if self.servo.value == BY_NEED else str(self.servo.value)
            names = [name for name, box in self.formats.items() if box.value]
            bundle = self._on_export(which, names, servo, self._wanted_printer(names))
        except (ValueError, OSError) as error:
            if asked == self._choices:
                self.tell(str(error))
        else:
            if asked == self._choices:
                self.tell(None)
                self._offer(bundle)
        finally:
            self.check.disabled = False

    def _wanted_printer(self, formats: Sequence[str]) -> str | None:
        """Return the printer that must be able to print every part; None where nothing was asked for."""
        word = self.printer.value.strip()
        return None if "3mf" not in formats or word in ("", DEFAULT.name) else word

    def send(self, client: viser.ClientHandle | None) -> None:
        """Hand the prepared bundle to the browser that asked for it."""
        if self._bundle is not None and client is not None:
            client.send_file_download(self._bundle.name, self._bundle.content, save_immediately=True)

    def tell(self, sentence: str | None, colour: str = wording.RED) -> None:
        """Show a sentence in the panel; None takes the last one away."""
        self.notice.visible = sentence is not None
        self.notice.content = wording.alert(sentence, colour) if sentence else ""

    def _offer(self, bundle: Bundle) -> None:
        self._bundle = bundle
        lines = []
        for name, box in self.formats.items():
            sizes = [len(content) for path, content in bundle.files.items() if _is_of(name, path)]
            if box.value and sizes:
                lines.append((f"✓ {name}, {len(sizes)} files", wording.size(sum(sizes))))
        policy = [len(content) for path, content in bundle.files.items() if "policy" in path]
        if policy:
            lines.append(("✓ policy and its program", wording.size(sum(policy))))
        agreed = f'<span style="color:{wording.GREEN};font-weight:600">✓ {len(bundle.checks)} comparisons agree</span>'
        if FILE in bundle.files:
            table = msgspec.json.decode(bundle.files[FILE], type=ServoTable)
            colour = wording.GREEN if table.suffices else wording.RED
            agreed += f'<br><span style="color:{colour}">{verdict(table)}</span>'
        hint = wording.dim("watch the .mjz: drop it on live.mujoco.org") if self.formats["mjcf"].value else ""
        name = f'<span style="overflow-wrap:anywhere">{wording.text(bundle.name)}</span>'  # which design it is
        self.result.content = wording.rows(lines) + wording.paragraph(f"{agreed}<br>{name}<br>{hint}")
        self.result.visible = True
        self.download.label = f"Download {wording.size(len(bundle.content))}"
        self.download.visible = True

    def _forget(self) -> None:
        """Drop a bundle that is not what is chosen any more."""
        self._bundle = None
        self._choices += 1
        self.tell(None)
        self.result.visible = self.download.visible = False

    def _choose(self) -> None:
        self._forget()
        self.iteration.visible = self.design.visible and self.design.value == "iteration"

    def _show(self, visible: bool) -> None:
        self.design.visible = self.ways.visible = visible
        self.servo.visible = visible and self._takes_servos
        self.iteration.visible = visible and self.design.value == "iteration"
