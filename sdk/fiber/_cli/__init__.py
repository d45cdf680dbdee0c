"""The command ``fiber``: programs, pools and the cluster that they run on.

Each file has one command or group of commands, and ``main.py`` lists them.  ``session.py`` connects
to the cluster, ``failures.py`` has the errors and exit statuses, and ``display.py`` prints.
"""
