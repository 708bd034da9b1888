"""All codecs by name and by number, and the decoders that they make."""

from collections.abc import Iterator, Mapping
from functools import cached_property

from vibrocast.codec import dct, eva, mdct, parametric, plugins, slp
from vibrocast.codec.interface import Codec, CodecError, Decoder

BUILT_IN: dict[str, Codec] = {
    codec.name: codec for codec in (mdct.CODEC, dct.CODEC, slp.CODEC, eva.CODEC, parametric.CODEC)
}
PEERS: dict[str, Codec] = {}
"""Codecs of other projects that a benchmark adds: they are found by name and number, and not listed in CODECS."""
_REMOVED = {5: "opus", 6: "amr-nb", 7: "g723-1", 8: "g726", 9: "wavpack", 10: "flac", 12: "lapped"}
"""Numbers in stream headers that no other codec may take."""
DEFAULT_CODEC = mdct.NAME


class Codecs(Mapping[str, Codec]):
    """All codecs by name: the built-in ones, those of other packages (codec/plugins.py), those added in this process.

    The packages are loaded at first use. `failures`: errors of packages' codecs that cannot be used, by entry point.
    """

    def __init__(self) -> None:
        self._added: dict[str, Codec] = {}

    def add(self, codec: Codec) -> None:
        """Add a codec, or replace an added one. Raises CodecError if a package or vibrocast has the name."""
        if codec.name in self._loaded[0]:
            raise CodecError(f"there is a codec {codec.name} already; rename yours")
        self._added[codec.name] = codec

    @cached_property
    def _loaded(self) -> tuple[dict[str, Codec], dict[str, str]]:
        others, failures = plugins.load(BUILT_IN)
        return {**BUILT_IN, **others}, failures

    @property
    def failures(self) -> dict[str, str]:
        """Why codecs of packages cannot be used, by entry point."""
        return self._loaded[1]

    def __getitem__(self, name: str) -> Codec:
        return BUILT_IN.get(name) or self._added.get(name) or self._loaded[0][name]

    def __iter__(self) -> Iterator[str]:
        return iter({**self._loaded[0], **self._added})

    def __len__(self) -> int:
        return len(self._loaded[0]) + len(self._added)


CODECS = Codecs()


def codec_by_name(name: str) -> Codec:
    """Return the codec of that name. Raises CodecError when there is none."""
    for known in (CODECS, PEERS):
        if name in known:
            return known[name]
    if name in CODECS.failures:
        raise CodecError(f"the codec {name} cannot be loaded: {CODECS.failures[name]}; repair or remove its package")
    raise CodecError(f"there is no codec {name!r}; `vibrocast codecs` lists them")


def codec_by_identifier(identifier: int, configuration: bytes = b"") -> Codec:
    """Return the codec of this number in stream headers. Raises CodecError when there is none.

    `configuration`: the header's, which names a codec of another package.
    """
    if identifier == plugins.IDENTIFIER:
        name = plugins.name_in(configuration)
        if name not in CODECS:
            raise CodecError(f"the stream needs the codec {name!r}; install the package that brings it, or register it")
        return CODECS[name]
    for codec in (*BUILT_IN.values(), *PEERS.values()):
        if codec.identifier == identifier:
            return codec
    if identifier in _REMOVED:
        raise CodecError(
            f"the stream has the former codec {_REMOVED[identifier]}, which only earlier versions play; encode the "
            "recording again"
        )
    raise CodecError(f"the stream needs codec number {identifier}, which this version lacks; update vibrocast")


def decoder(
    identifier: int, configuration: bytes, channels: int, tables: bytes | None = None, runtime: str | None = None
) -> Decoder:
    """Make the decoder of a stream from its header's fields, as `Codec.decoder` does. Raises CodecError."""
    return codec_by_identifier(identifier, configuration).decoder(configuration, channels, tables, runtime)


def check_tables(identifier: int, tables: bytes) -> None:
    """Raise CodecError for the payload of a model image that a codec's decoders reject."""
    codec = codec_by_identifier(identifier)
    codec.check_model(given=True)
    assert codec.tables is not None, f"{codec.name} takes a model"
    codec.tables.check(tables)
