"""Writes the tiny model that the tests of `eva` use: python -m tests.codec.make_eva_model"""

from pathlib import Path

from tests.export import tiny

FOLDER = Path(__file__).parent
LAMBDA = 60.0
"""At which textures have some 16 dB of SNR."""


def main() -> None:
    """Write tiny_eva.vcmi and tiny_eva_analysis.onnx."""
    made = tiny.package("both", "tiny", LAMBDA)
    FOLDER.joinpath("tiny_eva.vcmi").write_bytes(made.image)
    FOLDER.joinpath("tiny_eva_analysis.onnx").write_bytes(made.graphs.analysis)


if __name__ == "__main__":
    main()
