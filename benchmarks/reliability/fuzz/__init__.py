"""Damaged and hostile files for every reader: mutators, targets, the contract."""
