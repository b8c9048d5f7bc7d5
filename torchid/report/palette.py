"""Colours of all figures: the palette of Okabe and Ito, which the colour-blind tell apart."""

MEASURED, NOMINAL, IDENTIFIED, NOISE = "#111111", "#d55e00", "#0072b2", "#8c8c8c"
"""Of measured forces, of the URDF's and of identified parameters and what they predict, and of noise."""

CATEGORIES = ("#56b4e9", "#f0e442", "#009e73", "#cc79a7", "#e69f00", NOISE, IDENTIFIED, NOMINAL)
"""Of things that have no order; then again from the first."""
