"""Import of foreign videos and pictures: files enter, a recording leaves."""
