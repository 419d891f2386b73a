"""Quantiles of the normal distribution."""

#: Half-widths of two-sided 95 % and 68 % intervals, in standard deviations.
TWO_SIDED_95, TWO_SIDED_68 = 1.959964, 0.994458
#: Distance of a one-sided 95 % limit from the value, in standard deviations.
ONE_SIDED_95 = 1.644854
