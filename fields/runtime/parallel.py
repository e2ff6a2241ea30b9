"""How CPU loops reach all threads.

Taichi 1.7.4 hands out the iterations of a parallel CPU loop 512 at a time, whatever `block_dim` says: a loop over fewer
runs on one thread. A loop over n heavy tasks is therefore written as

    for i in range(n * SPREAD):
        if i % SPREAD == 0:
            self._task(i // SPREAD)

with SPREAD = HANDED_OUT // (tasks that a thread takes at a time). The empty iterations cost below a nanosecond each.
"""

__all__ = ["HANDED_OUT"]

HANDED_OUT = 512
