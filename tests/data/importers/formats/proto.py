"""Messages of other programs, written by the protobuf library from short schemas.

A line of a schema is a message, "NAME: field number type, ...". A type of messages has
a dot before it (and the package, if it is another), a list a star behind it, an enum a
slash before it; the values of an enum are a line "MESSAGE/ENUM: VALUE number, ...".
"""

from types import SimpleNamespace

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory


def file_of(package, text):
    """FileDescriptorProto of a schema."""
    file = descriptor_pb2.FileDescriptorProto(name=f"{package}.proto", package=package)
    messages = {}
    for line in filter(None, text.strip().splitlines()):
        name, _, entries = line.partition(":")
        name, _, enum = name.partition("/")
        entries = [entry.split() for entry in entries.split(",") if entry.strip()]
        if enum:
            values = messages[name].enum_type.add(name=enum).value
            for label, number in entries:
                values.add(name=label, number=int(number))
        else:
            messages[name] = file.message_type.add(name=name)
            for entry in entries:
                _add(messages[name].field.add(), package, *entry)
    return file


def _add(field, package, name, number, kind):
    field.name, field.number = name, int(number)
    is_list, kind = kind.endswith("*"), kind.rstrip("*")
    field.label = field.LABEL_REPEATED if is_list else field.LABEL_OPTIONAL
    named = {".": field.TYPE_MESSAGE, "/": field.TYPE_ENUM}
    if kind[0] in named:
        full = kind[1:] if "." in kind[1:] else f"{package}.{kind[1:]}"
        field.type, field.type_name = named[kind[0]], f".{full}"
    else:
        field.type = field.Type.Value(f"TYPE_{kind.upper()}")


def classes(packages):
    """Classes of all messages of some schemas; later ones know earlier ones."""
    pool, known, found = descriptor_pool.DescriptorPool(), [], {}
    for package, text in packages.items():
        file = file_of(package, text)
        file.dependency.extend(known)
        pool.Add(file)
        known.append(file.name)
        for message in file.message_type:
            kind = pool.FindMessageTypeByName(f"{package}.{message.name}")
            found[message.name] = message_factory.GetMessageClass(kind)
    return SimpleNamespace(**found)


def written(kind, **fields):
    """Bytes of a message."""
    return kind(**fields).SerializeToString(deterministic=True)
