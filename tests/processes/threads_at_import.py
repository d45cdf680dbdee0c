"""A module whose import starts a thread, after which a process must not be forked."""

import threading

threading.Thread(target=threading.Event().wait, name="started at import", daemon=True).start()
