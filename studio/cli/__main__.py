"""Entry of `python -m studio.cli`, which does what `morph-studio` does."""

from studio.cli import main

main()
