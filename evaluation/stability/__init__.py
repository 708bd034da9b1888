"""Where each method holds and where it fails: trials in hard conditions, their maps, the page of boundaries."""
