"""Damaged and hostile files for every reader; the tests run them."""
