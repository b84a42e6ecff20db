"""The datagram link, both ends: sealed datagrams enter, messages leave."""
