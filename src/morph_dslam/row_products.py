"""Products of rows of numbers, compiled."""

from __future__ import annotations

from numba import njit

#: Sums may be taken in any order: half the time.
FAST = {"reassoc", "contract", "nsz"}


@njit(cache=True, nogil=True, fastmath=FAST)
def row_products(a, b, c, first, second):
    """Sums of the products of each of three rows (n,) and each of two, in any order.

    In one pass: a number that is read then counts for several products.
    """
    a1, a2, b1, b2, c1, c2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(first)):
        a1 += a[i] * first[i]
        a2 += a[i] * second[i]
        b1 += b[i] * first[i]
        b2 += b[i] * second[i]
        c1 += c[i] * first[i]
        c2 += c[i] * second[i]
    return a1, a2, b1, b2, c1, c2
