"""Puts morph-studio.pth beside the packages, in wheels and in editable installs: see morph_core/startup.py."""

from setuptools import setup
from setuptools.command.build_py import build_py

PTH = "morph-studio.pth"


class BuildWithPth(build_py):
    """Copies the file to where what is built will be put, which is elsewhere for an editable install."""

    def run(self) -> None:
        super().run()
        self.copy_file(PTH, self.get_finalized_command("install").install_lib if self.editable_mode else self.build_lib)


setup(cmdclass={"build_py": BuildWithPth})
