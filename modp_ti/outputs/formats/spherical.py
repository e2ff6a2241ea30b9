"""What tells viewers that a picture or a video sees all round: GPano in PNG, Spherical Video (version 1) in MP4."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

RDF = '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
GPANO = (
    f'<x:xmpmeta xmlns:x="adobe:ns:meta/">{RDF}<rdf:Description rdf:about="" '
    'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" GPano:ProjectionType="equirectangular" '
    'GPano:UsePanoramaViewer="True" GPano:CroppedAreaLeftPixels="0" GPano:CroppedAreaTopPixels="0" '
    'GPano:CroppedAreaImageWidthPixels="{0}" GPano:CroppedAreaImageHeightPixels="{1}" '
    'GPano:FullPanoWidthPixels="{0}" GPano:FullPanoHeightPixels="{1}"/></rdf:RDF></x:xmpmeta>'
)
SPHERICAL = (
    '<?xml version="1.0"?><rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
    'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/"><GSpherical:Spherical>true</GSpherical:Spherical>'
    "<GSpherical:Stitched>true</GSpherical:Stitched><GSpherical:StitchingSoftware>MODP-Ti"
    "</GSpherical:StitchingSoftware><GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType>"
    "</rdf:SphericalVideo>"
)
UUID = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")
# Where the first chunk after PNG's signature and IHDR begins.
AFTER_IHDR = 33


def spherical_png(data: bytes) -> bytes:
    """Return a PNG file's content with the metadata of an equirectangular panorama."""
    xmp = GPANO.format(*struct.unpack(">2I", data[16:24])).encode("ascii")
    content = b"XML:com.adobe.xmp" + bytes(5) + xmp
    chunk = struct.pack(">I", len(content)) + b"iTXt" + content + struct.pack(">I", zlib.crc32(b"iTXt" + content))
    return data[:AFTER_IHDR] + chunk + data[AFTER_IHDR:]


def mark_spherical_mp4(path: Path) -> None:
    """Add the metadata of an equirectangular video to an MP4 file of one track, whose index is its last box.

    The metadata is the last box of the track, so that only the sizes of `moov` and `trak` change.
    """
    box = struct.pack(">I4s", 24 + len(SPHERICAL), b"uuid") + UUID + SPHERICAL.encode("ascii")
    with path.open("r+b") as file:
        place = _find(file, 0, b"moov")
        file.seek(place)
        moov = bytearray(file.read())
        trak = _find(io.BytesIO(moov), 8, b"trak")
        end = trak + int.from_bytes(moov[trak : trak + 4], "big")
        for at in (0, trak):
            moov[at : at + 4] = (int.from_bytes(moov[at : at + 4], "big") + len(box)).to_bytes(4, "big")
        file.seek(place)
        file.write(moov[:end] + box + moov[end:])


def _find(file: BinaryIO, at: int, kind: bytes) -> int:
    """Return where the first box of a kind begins, from a place on at which a box begins."""
    while True:
        file.seek(at)
        head = file.read(16)
        if head[4:8] == kind:
            return at
        size = int.from_bytes(head[:4], "big")
        at += int.from_bytes(head[8:], "big") if size == 1 else size
