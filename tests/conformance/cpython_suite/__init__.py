"""CPython's own multiprocessing tests, run against another module.

No CPython code is copied. ``test._test_multiprocessing`` of the running interpreter is executed
with a private ``__import__`` (`redirect`), so that every ``import multiprocessing`` in it, in the
parent and in children, yields the module under test. Its classes are then rebuilt (`build`) under
CPython's ids in one importable module (`cases`), which is what children unpickle from.

Environment: ``MP_MODULE`` names the module under test, ``MP_START_METHOD`` the start method, and
``MP_TIERS`` the tiers of `tiers` to keep.
"""
