"""Quantiles of the normal law."""

#: Half widths of two-sided 95 % and 68 % intervals, in standard deviations.
TWO_SIDED_95, TWO_SIDED_68 = 1.959964, 0.994458
#: Standard deviations between a value and its one-sided 95 % limit.
ONE_SIDED_95 = 1.644854
