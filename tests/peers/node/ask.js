// Asks what it is told on standard input, [{unit, function, first, count, values}], of HOST PORT by modbus-serial, and
// prints what came of each: the values, or {"exception": code}.
"use strict";
const ModbusRTU = require("modbus-serial");
const fs = require("fs");

async function ask(client, step) {
  const { first, count, values } = step;
  switch (step.function) {
    case 1: return (await client.readCoils(first, count)).data.slice(0, count).map(Number);
    case 2: return (await client.readDiscreteInputs(first, count)).data.slice(0, count).map(Number);
    case 3: return (await client.readHoldingRegisters(first, count)).data;
    case 4: return (await client.readInputRegisters(first, count)).data;
    case 5: return client.writeCoil(first, Boolean(values[0]));
    case 6: return client.writeRegister(first, values[0]);
    case 15: return client.writeCoils(first, values.map(Boolean));
    case 16: return client.writeRegisters(first, values);
    default: throw new Error(`no such function: ${step.function}`);
  }
}

async function main() {
  const client = new ModbusRTU();
  client.setTimeout(10000);
  await client.connectTCP(process.argv[2], { port: Number(process.argv[3]) });
  const results = [];
  for (const step of JSON.parse(fs.readFileSync(0, "utf8"))) {
    client.setID(step.unit);
    try {
      results.push(await ask(client, step));
    } catch (error) {
      if (error.modbusCode === undefined) throw error;
      results.push({ exception: error.modbusCode });
    }
  }
  console.log(JSON.stringify(results));
  client.close(() => {});
}

main().catch((error) => { console.error(error); process.exit(1); });
