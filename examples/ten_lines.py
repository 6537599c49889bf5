"""MORPH from a script: co-optimise the reacher's links and its policy, and print a line per iteration."""

from itertools import islice

from morph_core.morph import morph
from morph_core.state import start
from morph_core.tasks import make_task

task = make_task("reacher")
state = start(task, task.config, seed=0)
for progress in islice(morph(task, task.config, state), 100):
    links = " ".join(f"{length:.2f}" for length in progress.phi)
    print(f"{progress.iteration:3d}  success {progress.success:4.2f}  links {links} m")
