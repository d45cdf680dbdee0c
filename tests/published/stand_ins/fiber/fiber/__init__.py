"""The names of fiber, bound to multiprocessing: the run that Fiber's runs are compared with."""

import multiprocessing.managers
import sys

sys.modules["fiber"] = multiprocessing
sys.modules["fiber.managers"] = multiprocessing.managers
