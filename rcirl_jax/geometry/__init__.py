"""Frenet frames, polynomials, boxes."""
