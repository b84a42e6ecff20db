"""Registration of a tracker: its poses and the markers enter, two poses leave."""
