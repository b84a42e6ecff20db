"""The live master: datagrams enter, messages on one clock go to the solver."""
