"""pymodbus's own TCP server as a user would put it up: `pymodbus_server.py PORT`; register i holds i."""

import asyncio
import sys

from pymodbus.server import StartAsyncTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

if __name__ == "__main__":
    registers = SimData(0, values=list(range(128)), datatype=DataType.REGISTERS)
    asyncio.run(StartAsyncTcpServer(SimDevice(0, [registers]), address=("127.0.0.1", int(sys.argv[1]))))
