"""What both ends of the datagram link share; datagrams enter, events leave."""
