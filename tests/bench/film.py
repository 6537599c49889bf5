"""What a film of a run's evolution takes: CPU seconds of all processes, by the clock, and the size of the file.

    python tests/bench/film.py RUN [--jobs N] [--seconds S]

RUN is the path of a run folder. A machine that does other things inflates CPU seconds, and more so the clock.
"""

import argparse
import resource
import tempfile
import time
from pathlib import Path

from morph_core.history import History
from morph_core.run_folder import RunFolder
from studio.film.plan import plan_evolution
from studio.film.reel import Reel
from studio.limits import cores


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--jobs", type=int, default=len(cores()))
    parser.add_argument("--seconds", type=float)
    arguments = parser.parse_args()
    history = History(RunFolder(arguments.run.resolve()))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "evolution.mp4"
        began = time.perf_counter()
        reel = Reel.of(plan_evolution([history], (1920, 1080), 30, arguments.seconds), out)
        reel.render(arguments.jobs, lambda _: None)
        reel.join()
        clock, size = time.perf_counter() - began, out.stat().st_size
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    seconds = sum(u.ru_utime + u.ru_stime for u in used)
    print(f"{history.folder.id}: {history.iteration} iterations, {reel.frames} frames, {arguments.jobs} processes")
    print(f"{seconds:.0f} CPU s ({1000 * seconds / reel.frames:.0f} ms a frame), {clock:.0f} s by the clock")
    print(f"{size / 1e6:.1f} MB, {max(u.ru_maxrss for u in used) / 1024:.0f} MB of memory in the largest process")


if __name__ == "__main__":
    main()
