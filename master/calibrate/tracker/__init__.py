"""Where a tracking system lies in the rig, and where its device sits on an object that the cameras see, too."""
