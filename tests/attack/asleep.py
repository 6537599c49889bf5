"""`morph-studio` whose trainers learn nothing: everything else is as it is, and an attack may start any run.

`python -m tests.attack.asleep serve ...`
"""

import subprocess
import sys

from morph_core.run_folder import RunFolder
from studio import app, trainers
from studio.cli import main
from tests.studio.conftest import stand_in


class Asleep(trainers.Reserve):
    """A reserve that loads no trainer, and spawns ones that only obey commands."""

    def load(self) -> None:
        """Load nothing."""

    def spawn(
        self, folder: RunFolder, *, further: int | None = None, from_start: bool = False
    ) -> subprocess.Popen[bytes]:
        """Start a process that keeps the trainer's side of the run folder."""
        return stand_in(folder, further=further, from_start=from_start)


if __name__ == "__main__":
    app.Reserve = Asleep
    sys.exit(main())
