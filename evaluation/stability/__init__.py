"""Where each method holds and where it fails: trials in hard conditions, their maps, and the page that names the bounds."""
