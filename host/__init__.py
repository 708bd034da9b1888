"""What a person runs: the vibrocast command, streaming player, flasher."""
