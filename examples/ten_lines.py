"""MORPH from a script: co-optimise the reacher's links and its policy, and print a line per iteration."""

from itertools import islice

from morph_core import make_method, make_task, start

task = make_task("reacher")
method = make_method("morph", task)
state = start(task, method, seed=0)
for progress in islice(method.iterations(task, state), 100):
    links = " ".join(f"{length:.2f}" for length in progress.phi)
    print(f"{progress.iteration:3d}  success {progress.success:4.2f}  links {links} m")
