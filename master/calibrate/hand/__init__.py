"""A hand of its own: a guided routine enters, bone lengths and markers leave."""
