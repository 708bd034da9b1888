"""The duties of every controller, over every transport."""
