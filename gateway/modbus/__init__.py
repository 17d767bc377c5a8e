"""The wire formats, sans-IO: CRC, PDUs, the RTU client, the MBAP splitter. Time is an argument."""
