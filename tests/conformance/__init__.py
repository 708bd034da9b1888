"""What every controller must do, whichever way it is reached."""
