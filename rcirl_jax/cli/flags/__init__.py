"""What the commands share: their flags, help, one-line errors and provenance.

Each file defines the flags of one subject and turns them into the package's settings;
the first line of its docstring is their heading in `--helpfull`. A flag that several
commands read is added here, one of a single command in its file.
"""
