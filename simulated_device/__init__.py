"""A tactor controller in software: same protocol, same decoder, DAC and actuator response."""
