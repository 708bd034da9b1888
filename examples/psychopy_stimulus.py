"""Plays textures in the trials of a script, such as PsychoPy's: `python examples/psychopy_stimulus.py [DEVICE]`."""

import sys
from pathlib import Path

import vibrocast

DEVICE = sys.argv[1] if len(sys.argv) > 1 else "sim"  # or "audio:CARD:CHANNEL@VOLTS", "serial:PORT"
oak = vibrocast.load(Path(__file__).with_name("oak.wav"))
stimuli = {f"{snr_db} dB": vibrocast.encode(oak, snr_db=snr_db) for snr_db in (20, 5)}  # before the first trial
with vibrocast.connect(DEVICE, actuator="voice-coil") as device:
    for name, stream in stimuli.items():  # with PsychoPy: for trial in psychopy.data.TrialHandler(...)
        # Here PsychoPy draws the trial: text.draw(); window.flip()
        report = device.play(stream, gain_db=-6)  # returns when the texture has ended
        print(f"{name}: {report.seconds:.1f} s, {report.underruns} underruns")
        # Here PsychoPy waits for the answer: psychopy.event.waitKeys(keyList=["1", "2", "3", "4"])
