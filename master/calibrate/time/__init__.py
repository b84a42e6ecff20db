"""How late the frames of a camera are, from the tracks of a moving hand."""
