"""`python -m studio.cli`: the same as `morph-studio`."""

from studio.cli import main

main()
