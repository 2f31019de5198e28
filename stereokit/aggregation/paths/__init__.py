"""The compiled half of semi-global matching: paths of one row at a time.

Arrays and their places (``P`` levels to a pixel, one byte each; all rows of one worker fit its caches)::

    cost          (2, W, P)   costs of two rows, from the cost's row producer
    across        (2, W, P)   sums of the brackets of the two paths along each of those rows
    chains        (4, P)      path costs of those four paths at the pixels that they have reached
    state         (3, W, P)   path costs of the three paths that come from the row before
    lowest        (3, W)      the smallest path cost of each
    total         (32, P)     16 bit, sum over all paths of a few pixels, for selection
    sums          (H, W, P)   sum of the three brackets of the sweep that came first; the only volume
    path_minimum  (H, W)      smallest path cost of each pixel, where `sums` holds path costs instead (see below)

Each worker has buffers of its own but for `state` and `lowest`, which belong to a sweep, and the last two.

The diagonal paths stay in place: the path that arrives at column ``x`` in sweep row ``k`` lives in slot ``x - k``
(modulo W), or ``x + k`` for the other diagonal, so nothing is ever shifted.

A path cost is ``L = C + B`` with the *bracket* ``B(d) = min(L'(d), L'(d-1) + P1, L'(d+1) + P1, min L' + P2) - min L'``
of the pixel before (Hirschmueller 2008, equation 13), so ``0 <= B <= P2``, and the sum over n paths is
``n * C + sum B``. Costs up to ``C_max`` therefore stay exact in bytes while ``C_max + P2 <= 255``; the three
brackets of a sweep fit bytes while ``3 * P2 <= 255``, else `sums` is 16 bit. The 255 that pads the levels saturates
and never wins: seen from a level that exists it offers at least ``255 - C_max >= P2``.

With 4 paths a sweep has one bracket, and costs that are costly to recompute are computed once: the first visit
leaves the path costs ``L`` of its vertical path in `sums`. The bracket of row y follows from the path costs of the row
that the path came from, and ``L`` less the bracket is the cost (`recover_row`): the volume holds both. The sum over
the paths is then ``3 * C + L`` and the other three brackets.

Bound and measurement, 4 paths with recovered costs, 1242x375 with 128 levels (931 500 vectors of 64 cells), one thread
of a Zen 4 that begins two 512-bit operations per cycle of 3.65 GHz (0.13 ms per operation and volume) and moves
about 10 GB/s beyond its caches (6 ms per volume); operations are those on vectors, loads and stores apart::

                                     operations   bytes        bound     measured
    vertical path, first visit       12           writes 59.6M  5.6 ms    5.6 ms
    costs recovered                  11           reads 59.6M   5.6 ms    5.7 ms
    both paths along the row         26 + 10      caches        4.6 ms    5.4 ms
    vertical path and sum            33           caches        4.2 ms    8.5 ms
    selection                        10 + 15      caches        3.2 ms    3.5 ms

The volume lies outside the caches: its two passes are bound by memory, the rest by the arithmetic. So it is written
past the caches, which spares reading it first, and asked for `CHUNK` pixels ahead of its use, as the processor's own
prefetching ends with every page. The sum stays furthest from its bound: widening bytes to words takes half of its
operations, on ports that few of them share.
"""

from __future__ import annotations
