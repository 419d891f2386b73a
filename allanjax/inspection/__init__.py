"""Inspection of a recording before a fit: handling, motion, units and resolution."""

from allanjax.inspection.first_look import Inspection, inspect, look
from allanjax.inspection.plausible import Ends
from allanjax.inspection.windows import Windows

__all__ = ["Ends", "Inspection", "Windows", "inspect", "look"]
