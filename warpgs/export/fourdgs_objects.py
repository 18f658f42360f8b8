"""The stream ``object_id`` of a .4dgs file, which the package ``fourdgs`` reads but does not write in this model."""

from typing import Any

import numpy as np
from jaxtyping import Int64


def with_object_ids(content: bytes, objects: Int64[np.ndarray, " N"]) -> bytes:
    """A file of ``keyframe_delta_file.write_sequence`` with the objects of its N Gaussians in all keyframes.

    Keyframes become longer, so the offsets of chunks in what follows are replaced.
    """
    from fourdgs import opcode, records, serialization  # not installed everywhere; the caller has imported it

    stream = serialization.encode_stream(opcode.A_OBJECT_ID, objects)
    margin = len(serialization.MAGIC)  # at both ends
    moved, made = dict[int, int](), bytearray(content[:margin])
    lengths = dict[int, int]()
    for record in serialization.iter_records(content[:-margin], margin):
        at = moved[record.offset] = len(made)
        if record.opcode == opcode.CHUNK:
            head, streams = records.parse_chunk(record.content)
            part = records.encode_chunk(head.t0, head.t1, head.level, head.count, bytes(streams) + stream)
        elif record.opcode == opcode.DELTA_CHUNK:
            part = _moved_delta(records, record.content, moved)
        elif record.opcode == opcode.CHUNK_INDEX:
            entry = records.ChunkIndexEntry.parse(record.content)
            for name in ("chunk_offset", "reference_offset", "keyframe_offset"):
                setattr(entry, name, moved.get(getattr(entry, name), 0))  # 0: a keyframe refers to none
            entry.chunk_length = lengths[entry.chunk_offset]
            part = entry.encode()
        elif record.opcode == opcode.FOOTER:
            start = moved[records.Footer.parse(record.content).summary_start]
            part = records.Footer(start, 0, serialization.crc32(bytes(made[start:]))).encode()
        else:
            part = serialization.put_record(record.opcode, bytes(record.content))
        lengths[at] = len(part)
        made += part
    return bytes(made) + content[-margin:]


def _moved_delta(records: Any, content: memoryview, moved: dict[int, int]) -> bytes:
    """A delta chunk that refers to where its reference and its keyframe are now."""
    head, *groups = records.parse_delta_chunk(content)
    return bytes(
        records.encode_delta_chunk(
            head.t0,
            head.t1,
            head.level,
            head.delta_mode,
            moved[head.reference_offset],
            moved[head.keyframe_offset],
            head.depth,
            *map(bytes, groups),
            (head.update_count, head.birth_count, head.death_count),
        )
    )
