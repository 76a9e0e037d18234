// A CANopen master made of the npm package `canopen`: enables and moves a CiA 402 drive.
// Frames are 16 bytes of struct can_frame on stdin and stdout; the result is one line of JSON on stderr.
const { DataType, Device, Eds } = require('canopen');

const [id, edsPath] = [Number(process.argv[2]), process.argv[3]];
const master = new Device({ eds: new Eds(), id: 0x7F });
let rest = Buffer.alloc(0);
process.stdin.on('data', (chunk) => {
    rest = Buffer.concat([rest, chunk]);
    for (; rest.length >= 16; rest = rest.subarray(16))
        master.receive({ id: rest.readUInt32LE(0), data: Buffer.from(rest.subarray(8, 8 + rest[4])) });
});
master.addListener('message', ({ id, data }) => {
    const frame = Buffer.alloc(16);
    frame.writeUInt32LE(id, 0);
    frame[4] = data.length;
    data.copy(frame, 8);
    process.stdout.write(frame);
});
master.eds.addSdoClientParameter(id, 0x600 + id, 0x580 + id);
const statusObject = master.eds.addEntry(0x2000, { parameterName: 'status', dataType: DataType.UNSIGNED16 });
master.eds.addReceivePdo({ cobId: 0x180 + id, dataObjects: [statusObject] });

const types = { 0x6040: 'UNSIGNED16', 0x6041: 'UNSIGNED16', 0x6060: 'INTEGER8', 0x6064: 'INTEGER32',
    0x606C: 'INTEGER32', 0x6071: 'INTEGER16', 0x6077: 'INTEGER16', 0x607A: 'INTEGER32', 0x60FF: 'INTEGER32',
    0x6098: 'INTEGER8', 0x6502: 'UNSIGNED32', 0x1018: 'UNSIGNED32', 0x1008: 'VISIBLE_STRING', 0x2100: 'VISIBLE_STRING' };
const read = (index, subIndex = 0, blockTransfer = false) => master.sdo.upload(
    { serverId: id, index, subIndex, dataType: DataType[types[index]], timeout: 5000, blockTransfer });
const write = (index, data, subIndex = 0, blockTransfer = false) => master.sdo.download(
    { serverId: id, index, subIndex, data, dataType: DataType[types[index]], timeout: 5000, blockTransfer });
const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
async function until(condition) {
    for (let i = 0; i < 1000; ++i) {
        if (await condition())
            return true;
        await pause(5);
    }
    return false;
}
async function state(word, mask, value) {
    await write(0x6040, word);
    return until(async () => ((await read(0x6041)) & mask) === value);
}

async function main() {
    const seen = { pdos: 0 };
    seen.edsObjects = [...Eds.fromFile(edsPath).entries()].length;
    master.start();
    master.pdo.on('pdo', () => ++seen.pdos);
    master.nmt.startNode();
    master.nmt.startNode(id);
    seen.name = await read(0x1008);
    seen.productCode = await read(0x1018, 2);
    seen.modes = await read(0x6502);

    const text = 'an elbow with a name that needs many segments, '.repeat(4);
    await write(0x2100, text, 0, true);
    seen.block = (await read(0x2100, 0, true)) === text;
    seen.segmented = (await read(0x2100)) === text;
    seen.refused = await write(0x6060, 2).then(() => 'accepted', (error) => error.code);

    await write(0x6060, 3);
    seen.enabled = await state(0x06, 0x6F, 0x21) && await state(0x07, 0x6F, 0x23) && await state(0x0F, 0x6F, 0x27);
    await write(0x60FF, -30000);
    seen.velocity = await until(async () => Math.abs((await read(0x606C)) + 30000) < 600);
    await write(0x60FF, 0);
    await until(async () => Math.abs(await read(0x606C)) < 200);

    await write(0x6098, 37);
    await write(0x6060, 6);
    await write(0x6040, 0x1F);
    seen.homed = await until(async () => ((await read(0x6041)) & 0x3400) === 0x1400);
    await write(0x6040, 0x0F);

    await write(0x6060, 1);
    await write(0x607A, 15000);
    await write(0x6040, 0x1F);
    seen.acknowledged = await until(async () => ((await read(0x6041)) & 0x1000) !== 0);
    await write(0x6040, 0x0F);
    seen.reached = await until(async () => ((await read(0x6041)) & 0x1400) === 0x0400);
    seen.position = await read(0x6064);

    await write(0x6060, 10);
    await write(0x6071, 30);
    seen.torque = await until(async () => (await read(0x6077)) === 30);
    await write(0x6071, 0);
    seen.disabled = await state(0x00, 0x4F, 0x40);
    return seen;
}

main().then((seen) => process.stderr.write(JSON.stringify(seen) + '\n', () => process.exit(0)),
    (error) => process.stderr.write(`${error.stack}\n`, () => process.exit(1)));
