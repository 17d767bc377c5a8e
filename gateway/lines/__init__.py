"""South: the asyncio shells that own a serial port."""
