"""How many random inputs the slow tests try: few in every run, more where the environment asks for them."""

import os

DESIGNS = int(os.environ.get("MORPH_TEST_DESIGNS", "8"))
"""Designs of each task, corners included; before a release MORPH_TEST_DESIGNS=100."""
