"""Signal to integers to bytes and back: transforms, quantisers, entropy coding, rate control."""
