"""Other projects' codecs: those that a benchmark measures itself, and the software behind a label in tables."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from vibrocast import codec as codecs
from vibrocast.evaluation import ffmpeg_codecs
from vibrocast.evaluation.points import read_rows

TABLE = Path(__file__).parent / "data" / "peers.csv"
codecs.PEERS.update({known.name: known for known in ffmpeg_codecs.CODECS})


@dataclass(frozen=True)
class Peer:
    """A codec of another project.

    `codec`: its label in tables. `software`: which program coded; empty for those that vibrocast calls itself.
    `delay_samples`: the algorithmic delay by its frames, None where its settings leave it open.
    """

    codec: str
    name: str
    software: str
    delay_samples: int | None


@cache
def peers() -> dict[str, Peer]:
    """Return the known codecs of other projects by label."""
    return {peer.codec: peer for peer in read_rows(TABLE, Peer)}


def measured_codecs() -> dict[str, codecs.Codec]:
    """Return every codec that a benchmark measures, by name: those that controllers decode, then those of FFmpeg."""
    return {**codecs.CODECS, **codecs.PEERS}


def named(codec: str) -> Peer:
    """Return the known codec of a label; one of that name alone where it is not known."""
    return peers().get(codec) or Peer(codec, codec, "", None)
