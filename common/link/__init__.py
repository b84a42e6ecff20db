"""What both ends of the sealed datagram link share; datagrams enter, events leave."""
