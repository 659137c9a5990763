"""Numbers of ROS messages. The message definition becomes a short program of struct formats, made once and
run for each message.

Layouts: ROS 2 writes CDR (OMG DDSI-RTPS 10.2, "classic CDR", and XCDR2 for final types), aligned to the size
of each number behind a header of four bytes. ROS 1 has no header and no alignment. Sequences and text begin
with their length (uint32). Text is skipped; fields behind a wide text cannot be read.
"""

import re
import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

ROS2_NUMBERS = {
    "bool": "?", "byte": "B", "char": "B", "octet": "B", "int8": "b", "uint8": "B", "int16": "h",
    "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
ROS1_NUMBERS = {**ROS2_NUMBERS, "byte": "b"}
ROS1_NUMBERS.pop("octet")
# types that many schema texts leave out, as every reader has them
KNOWN = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "ros1/time": "uint32 secs\nuint32 nsecs",
    "ros1/duration": "int32 secs\nint32 nsecs",
}
LARGEST_LAYOUT = 20_000
# numbers of one array: no message is as long as that
LARGEST_ARRAY = 1 << 30
LONGEST_LISTED = 64
_FIELD = re.compile(r"^([A-Za-z]\w*(?:/\w+)*)(?:<=\d+)?\s*(\[(?:<=)?(\d*)\])?\s+([A-Za-z]\w*)\s*(=?)")
# representation -> byte order, largest alignment; ROS does not write lists of parameters (0x0002, 0x0003 and
# others)
_REPRESENTATIONS = {
    b"\x00\x00": (">", 8),
    b"\x00\x01": ("<", 8),
    b"\x00\x06": (">", 4),
    b"\x00\x07": ("<", 4),
}
_LENGTH = {order: struct.Struct(order + "I") for order in "<>"}


class UnreadableMessage(ValueError):
    """A message that does not fit its schema."""


class Item(NamedTuple):
    """A stretch of the layout: `count` numbers of one `format`, text, or a sequence of `items` (an empty
    sequence of numbers has one item of count 1)."""

    kind: str
    path: str
    format: str = ""
    count: int = 1
    array: bool = False
    items: tuple = ()


def layout(definition: str, name: str, *, version: int) -> list[Item]:
    """The message's numbers, texts and sequences in the order of the wire. `version` is 1 or 2.

    Raises ValueError for a definition that cannot be read.
    """
    if re.search(r"^---", definition, re.MULTILINE):
        raise ValueError(f"the schema of {name} is a service's (---), not a message's")
    types = _types(definition, name, version)
    return _expand(_plain(name), "", types, version, [LARGEST_LAYOUT])


def _types(definition: str, name: str, version: int) -> dict[str, list[tuple[str, str, str | None]]]:
    """{type: [(field, its type, None | "" | length)]}; "" is a sequence without a fixed length."""
    parts = re.split(r"^={3,}\s*$", definition, flags=re.MULTILINE)
    texts = dict(KNOWN) | {_plain(name): parts[0]}
    for part in parts[1:]:
        head, _, body = part.strip().partition("\n")
        if not head.startswith("MSG:"):
            raise ValueError(f"the schema of {name} should have MSG: behind ==== but has {head[:40]!r}")
        texts[_plain(head[4:].strip())] = body
    return {kind: _fields(text, kind) for kind, text in texts.items()}


def _plain(name: str) -> str:
    return name.replace("/msg/", "/")


def _fields(text: str, kind: str) -> list[tuple[str, str, str | None]]:
    fields = []
    for line in text.splitlines():
        line = line.split("#")[0].strip()
        if not line:
            continue
        match = _FIELD.match(line)
        if not match:
            raise ValueError(f"the schema of {kind} has the line {line[:60]!r}, which is no field")
        if not match[5]:  # NAME=value is a constant and not on the wire
            fields.append((match[4], match[1], match[3] if match[2] else None))
    return fields


def _resolve(kind: str, parent: str, types: dict) -> str:
    candidates = [_plain(kind), f"{parent.rpartition('/')[0]}/{kind}", f"std_msgs/{kind}", f"ros1/{kind}"]
    candidates += [name for name in types if name.endswith(f"/{kind}")]
    for candidate in candidates:
        if candidate in types:
            return candidate
    raise ValueError(f"the schema of {parent} uses {kind} but does not define it")


def _expand(kind: str, prefix: str, types: dict, version: int, room: list[int]) -> list[Item]:
    items: list[Item] = []
    for field, of, length in types[kind]:
        path = f"{prefix}.{field}" if prefix else field
        count = _count(kind, field, length)
        if length == "":
            element = _element(of, path, kind, types, version, room)
            items.append(Item("sequence", path, items=tuple(element)))
        elif of in _numbers(version):
            items.append(Item("numbers", path, _numbers(version)[of], count, length is not None))
        else:
            for i in range(count):
                _take_room(kind, room)
                items += _element(of, f"{path}[{i}]" if length else path, kind, types, version, room)
        _take_room(kind, room)
    if not items and version == 2:
        items.append(Item("numbers", prefix + "._", "B"))  # ROS 2 gives a message without fields one byte
    return items


def _count(kind: str, field: str, length: str | None) -> int:
    """How often a field of the definition is on the wire; 1 for a single one and for a sequence."""
    if not length:
        return 1
    if len(length) > 12 or int(length) > LARGEST_ARRAY:
        raise ValueError(
            f"the schema of {kind} has {length[:20]} elements in {field}, more than any message can hold"
        )
    return int(length)


def _take_room(kind: str, room: list[int]) -> None:
    room[0] -= 1
    if room[0] < 0:
        raise ValueError(f"the schema of {kind} has more than {LARGEST_LAYOUT} parts")


def _numbers(version: int) -> dict[str, str]:
    return ROS2_NUMBERS if version == 2 else ROS1_NUMBERS


def _element(of: str, path: str, parent: str, types: dict, version: int, room: list[int]) -> list[Item]:
    if of in _numbers(version):
        return [Item("numbers", path, _numbers(version)[of])]
    if of in ("string", "wstring"):
        return [Item(of, path)]
    if path.count(".") > 30:
        raise ValueError(f"the schema of {parent} contains itself in {path}")
    return _expand(_resolve(of, parent, types), path, types, version, room)


# ---- which numbers a message has


def fields(items: Sequence[Item], sample: bytes | None, *, version: int) -> list[str]:
    """Paths of the numbers. Of a sequence they are those of the message `sample`, up to LONGEST_LISTED."""
    names: list[str] = []
    sequences = []
    for item in _readable(items):
        if item.kind == "numbers" and not item.path.endswith("._"):
            names += (
                [f"{item.path}[{i}]" for i in range(min(item.count, LONGEST_LISTED))]
                if item.array
                else [item.path]
            )
        elif item.kind == "sequence" and all(part.kind == "numbers" for part in item.items):
            sequences.append(item)
    if sample is not None and sequences:
        try:
            lengths = decoder(items, [f"{item.path}[#]" for item in sequences], version=version)([sample])[0]
        except UnreadableMessage:
            return names
        for item, length in zip(sequences, lengths, strict=True):
            for i in range(min(int(length), LONGEST_LISTED)):
                names += [
                    f"{item.path}[{i}]{part.path[len(item.path) :]}" for part in item.items if not part.array
                ]
    return names


def _readable(items: Sequence[Item]) -> list[Item]:
    """The items up to the first wide text, as writers do not agree on the length of its characters."""
    for i, item in enumerate(items):
        if item.kind == "wstring" or (
            item.kind == "sequence" and len(_readable(item.items)) < len(item.items)
        ):
            return list(items[:i])
    return list(items)


# ---- programs


class _FixedRow:
    """Numbers of fixed size in a row. `layouts[phase]` unpacks the wanted ones of a row that begins at that
    phase of the alignment."""

    def __init__(self, items: Sequence[Item], wanted: set[str], order: str, alignment: int):
        self.layouts = [
            struct.Struct(order + _row_format(items, wanted, phase, alignment)) for phase in range(8)
        ]
        self.names = [name for item in items for name in _names(item, wanted)]

    def read(self, data: bytes, pos: int, values: list[float]) -> int:
        unpack = self.layouts[pos & 7]
        values += unpack.unpack_from(data, pos)
        return pos + unpack.size


def _names(item: Item, wanted: set[str]) -> list[str]:
    """The wanted numbers of an item in the order of the wire. A long array is never written out."""
    if not item.array:
        return [item.path] if item.path in wanted else []
    return [f"{item.path}[{i}]" for i in _indices(item, wanted)]


def _indices(item: Item, wanted: set[str]) -> list[int]:
    if item.count <= LONGEST_LISTED:
        return [i for i in range(item.count) if f"{item.path}[{i}]" in wanted]
    places = (
        int(name[len(item.path) + 1 : -1])
        for name in wanted
        if name.startswith(f"{item.path}[") and re.fullmatch(r"\[\d{1,12}\]", name[len(item.path) :])
    )
    return sorted(i for i in places if i < item.count)


def _row_format(items: Sequence[Item], wanted: set[str], phase: int, alignment: int) -> str:
    parts, pos = [], phase
    for item in items:
        size = struct.calcsize("=" + item.format)
        pad = -pos % min(size, alignment) if item.count else 0
        parts.append(f"{pad}x")
        if not item.array:
            parts.append(item.format if item.path in wanted else f"{size}x")
        else:
            following = 0
            for i in _indices(item, wanted):
                parts += [f"{size * (i - following)}x", item.format]
                following = i + 1
            parts.append(f"{size * (item.count - following)}x")
        pos += pad + size * item.count
    return "".join(part for part in parts if part != "0x")


class _Text:
    names: Sequence[str] = ()

    def __init__(self, order: str, alignment: int):
        self.unpack, self.alignment = _LENGTH[order].unpack_from, min(4, alignment)

    def read(self, data: bytes, pos: int, values: list[float]) -> int:
        pos += -pos % self.alignment
        return pos + 4 + self.unpack(data, pos)[0]


class _Sequence:
    """A length and so many elements. Elements that are wanted by index are read (NaN if there are fewer), the
    others skipped. "[#]" is the length itself."""

    def __init__(self, item: Item, wanted: set[str], order: str, alignment: int):
        self.unpack, self.alignment = _LENGTH[order].unpack_from, min(4, alignment)
        indices = {
            int(match[1]) for name in wanted if (match := re.match(re.escape(item.path) + r"\[(\d+)\]", name))
        }
        self.skip = _program(item.items, set(), order, alignment)
        self.elements = {i: _program(_at(item, i), wanted, order, alignment) for i in sorted(indices)}
        self.length = f"{item.path}[#]" in wanted
        self.names = [f"{item.path}[#]"] * self.length + [
            name for steps in self.elements.values() for step in steps for name in step.names
        ]
        only = (
            item.items[0]
            if len(item.items) == 1 and item.items[0].kind == "numbers" and not item.items[0].array
            else None
        )
        self.size = struct.calcsize("=" + only.format) if only else 0
        self.element_alignment = min(self.size, alignment) if only else 1
        self.number = struct.Struct(order + only.format).unpack_from if only else None

    def read(self, data: bytes, pos: int, values: list[float]) -> int:
        pos += -pos % self.alignment
        length = self.unpack(data, pos)[0]
        pos += 4
        if length > len(data):
            raise UnreadableMessage(f"a sequence of {length} elements in {len(data)} bytes")
        if self.length:
            values.append(length)
        if self.number:
            return self._numbers(data, pos, length, values)
        for i in range(length):
            for step in self.elements.get(i, self.skip):
                pos = step.read(data, pos, values)
        for i, steps in self.elements.items():
            if i >= length:
                values += [np.nan] * sum(len(step.names) for step in steps)
        return pos

    def _numbers(self, data: bytes, pos: int, length: int, values: list[float]) -> int:
        if length:
            pos += -pos % self.element_alignment
        for i in self.elements:
            values.append(self.number(data, pos + i * self.size)[0] if i < length else np.nan)
        return pos + length * self.size


def _at(item: Item, i: int) -> list[Item]:
    """The elements of a sequence with their paths at index i."""
    start = len(item.path)
    return [
        part._replace(
            path=f"{item.path}[{i}]{part.path[start:]}", items=tuple(_at_prefix(part, item.path, i))
        )
        for part in item.items
    ]


def _at_prefix(part: Item, prefix: str, i: int) -> list[Item]:
    moved = [inner._replace(path=f"{prefix}[{i}]{inner.path[len(prefix) :]}") for inner in part.items]
    return [inner._replace(items=tuple(_at_prefix(inner, prefix, i))) for inner in moved]


def _program(items: Sequence[Item], wanted: set[str], order: str, alignment: int) -> list:
    steps, row = [], []
    for item in [*items, None]:
        if item is not None and item.kind == "numbers":
            row.append(item)
            continue
        if row:
            steps.append(_FixedRow(row, wanted, order, alignment))
            row = []
        if item is not None:
            steps.append(
                _Text(order, alignment)
                if item.kind == "string"
                else _Sequence(item, wanted, order, alignment)
            )
    return steps


def decoder(
    items: Sequence[Item], names: Sequence[str], *, version: int
) -> Callable[[list[bytes]], np.ndarray]:
    """A function from n messages to their numbers (n, len(names)). It raises UnreadableMessage for a message
    that does not fit the layout."""
    readable = _readable(items)
    exact = len(readable) == len(items)
    if version == 1:
        steps = _program(readable, set(names), "<", 1)
        order = _order(steps, names)
        return lambda messages: _decode(messages, steps, exact, 0)[:, order]
    programs = {code: _program(readable, set(names), *how) for code, how in _REPRESENTATIONS.items()}
    order = _order(programs[b"\x00\x01"], names)

    def decode(messages: list[bytes]) -> np.ndarray:
        codes = {message[:2] for message in messages}
        if len(codes) > 1:
            return np.concatenate([decode([message]) for message in messages])
        code = codes.pop()
        if code not in programs:
            raise UnreadableMessage(
                f"CDR representation 0x{code.hex()} is not read; 0x0000, 0x0001, 0x0006 and 0x0007 are"
            )
        # alignment counts from behind the header of four bytes
        return _decode([message[4:] for message in messages], programs[code], exact, 7)[:, order]

    return decode


def _order(steps: list, names: Sequence[str]) -> list[int]:
    read = [name for step in steps for name in step.names]
    missing = [name for name in names if name not in read]
    if missing:
        raise ValueError(f"no numeric field {missing[0]}")
    return [read.index(name) for name in names]


def _ends(data: bytes, size: int, exact: bool, padding: int) -> bool:
    """Whether a message ends behind its `size` bytes, but for padding. Four bytes and more could be a number
    of another schema, and must be zeros."""
    behind = len(data) - size
    return behind >= 0 and (
        not exact or behind <= min(3, padding) or (behind <= padding and not any(data[size:]))
    )


def _decode(messages: list[bytes], steps: list, exact: bool, padding: int) -> np.ndarray:
    """The numbers of the messages by the steps. Up to `padding` bytes may follow the last step."""
    rows = []
    try:
        if len(steps) == 1 and isinstance(steps[0], _FixedRow):
            unpack, size = steps[0].layouts[0].unpack_from, steps[0].layouts[0].size
            # most messages have no more than that, which takes no look at their bytes
            if not {len(data) for data in messages} <= set(range(size, size + min(3, padding) + 1)):
                wrong = [len(data) for data in messages if not _ends(data, size, exact, padding)]
                if wrong:
                    raise UnreadableMessage(f"a message of {wrong[0]} bytes where {size} are expected")
            rows = [unpack(data) for data in messages]
        else:
            for data in messages:
                values: list[float] = []
                pos = 0
                for step in steps:
                    pos = step.read(data, pos, values)
                if not _ends(data, pos, exact, padding):
                    raise UnreadableMessage(f"a message of {len(data)} bytes where {pos} are expected")
                rows.append(values)
    except struct.error as error:
        raise UnreadableMessage(f"a message that is too short ({error})") from None
    return np.array(rows, float).reshape(len(messages), -1)
