"""Lets every interpreter of a run import the original's private modules by their names."""

from pathlib import Path

import fiber

fiber.__path__.append(str(Path(__file__).with_name("private")))
