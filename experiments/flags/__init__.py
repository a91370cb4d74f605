"""What the commands share: their flags, one-line errors and provenance.

Each file defines the flags of one subject and turns them into the package's settings.
A flag that several commands read is added here, one of a single command in its file.
"""
