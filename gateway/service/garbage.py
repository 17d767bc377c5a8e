"""Python's garbage collector, kept away from what lasts.

A configuration of 200 controllers is 100,000 objects that live until the next reload, and a full collection looks at
each of them: 20 ms in which nobody is served. So they are set aside once they are made; the rest is looked at quickly.
"""

from __future__ import annotations

import gc


def set_aside() -> None:
    """Throw away what nobody uses, and never look at the rest again until this is called anew."""
    gc.unfreeze()
    gc.collect()
    gc.freeze()
