"""The programs that people run: the vibrocast command, streaming player, uploader."""
