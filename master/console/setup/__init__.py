"""Set-up in the browser: an empty folder enters, a calibrated rig leaves."""
