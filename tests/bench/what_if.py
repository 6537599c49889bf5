"""How soon a what-if question is answered: from a slider's value to the moved body, and to the success on it.

Starts a real server on a copy of a run, opens the panel by a raw websocket client, and drags one slider; a browser's
own rendering comes on top. The CPU seconds of server and evaluating process say what it would take on idle cores.
"""

import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from visitors import Browser, changes_robot, process_of, seconds_of, served, visit


@dataclass(frozen=True)
class WhatIf:
    """What to ask."""

    run: tyro.conf.Positional[Path]
    """Folder of a run that has ended, with checkpoints."""
    drags: int = 10
    before_start: float = 3.0
    """Seconds between the opened page and the first press."""
    slider: str = ""
    """Label of the slider; by default the last one."""


def tells_success(message: dict[str, Any]) -> bool:
    """Tell whether a message says how often the policy succeeds on a changed body."""
    content = str(message.get("updates", {}).get("content", ""))
    return message["type"] == "GuiUpdateMessage" and "<b>success</b>" in content and "this body" in content


def main(options: WhatIf) -> None:
    with tempfile.TemporaryDirectory() as runs:
        shutil.copytree(options.run, Path(runs) / options.run.name)
        with served(Path(runs)) as (port, _):
            measure(port, options)


def measure(port: int, options: WhatIf) -> None:
    with visit(port) as connection:
        browser = Browser(connection)
        browser.until(lambda _: "Change this body…" in browser.labels)
        time.sleep(options.before_start)  # the viewer has been told of the run by then
        before = set(browser.labels)
        browser.send(browser.labels["Change this body…"][0], True)
        first = browser.until(lambda m: "<b>success</b>" in str(m.get("updates", {}).get("content", "")))
        print(f"first answer, with the process started for it: {first:.2f} s")
        sliders = [label for label in browser.labels if label not in before]
        uuid, slider = browser.labels[options.slider or sliders[-1]]
        values = np.linspace(slider["props"]["min"], slider["props"]["max"], options.drags + 2)[1:-1]
        server = process_of(port)
        processes = [server, *(c for c in server.children() if "morph_core.evaluator" in c.cmdline())]
        bodies, answers, costs = [], [], []
        for value in values:
            time.sleep(0.5)
            spent = [seconds_of(p) for p in processes]
            browser.send(uuid, round(float(value), 2))
            bodies.append(browser.until(changes_robot))
            answers.append(bodies[-1] + browser.until(tells_success))
            costs.append([seconds_of(p) - s for p, s in zip(processes, spent, strict=True)])
    print(f"slider to moved body: median {1e3 * np.median(bodies):.0f} ms, longest {1e3 * max(bodies):.0f} ms")
    print(f"slider to success over 128 episodes: median {np.median(answers):.2f} s, longest {max(answers):.2f} s")
    of_server, of_evaluator = np.median(costs, 0)
    print(f"CPU seconds of one drag: server {of_server:.2f}, evaluating process {of_evaluator:.2f}")


if __name__ == "__main__":
    main(tyro.cli(WhatIf, description=__doc__))
