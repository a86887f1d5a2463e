// The trigger's gateware as a shared library: clocks it, speaks UART with it, records what its pins do.
// DESIGN is the C++ that CXXRTL made of firmware/top.py.

#include DESIGN

#include <cstddef>
#include <cstdint>

using Top = cxxrtl_design::p_top;

struct Change {
    uint64_t clock;
    uint64_t pins;
};

// Input and output of a call of twin_run; the same in firmware/cxxrtl.py.
struct Exchange {
    const uint8_t *input;
    size_t inputs, taken;  // a byte counts as taken when its start bit is sent
    uint8_t *output;
    size_t outputs, made;
    Change *changes;  // none are recorded if there is no room
    size_t room, noted;
    uint8_t *light;  // a byte per sub-step that has ended: 1 if the LED was lit for more than half of it
    size_t light_room, lit;
};

// Observations of the latest run at the pins. All pins but `running` come PIN_CLOCKS behind it.
struct Run {
    uint64_t number = 0;  // from 1
    uint64_t running = 0;
    uint64_t pulses[2] = {0, 0};  // rising edges of the triggers
    uint64_t line_clocks = 0;     // 0: not known yet
    uint64_t delays[2] = {0, 0};  // clocks from a line to its pulse, of each trigger's first pulse
};

constexpr unsigned PIN_CLOCKS = 2;

struct Twin {
    Top top;
    Run run;
    uint64_t line_began = 0;
    uint64_t running_was = 0;  // the pin's latest levels, the newest in bit 0
    uint32_t lit_clocks = 0, substep_clocks = 0;
    bool lines = false;
    uint32_t divisor;
    uint64_t clock = 0;
    uint64_t pins = ~uint64_t{0};
    // to the device: a frame of ten bits, the low one first
    uint32_t sending = 0;
    uint32_t send_bits = 0;
    uint32_t send_timer = 0;
    // from the device
    uint32_t received = 0;
    uint32_t receive_bits = 0;
    uint32_t receive_timer = 0;
};

static uint64_t look(const Top &top) {
    return uint64_t(top.p_led.get<uint8_t>()) | uint64_t(top.p_trigger__a.get<uint8_t>()) << 1 |
           uint64_t(top.p_trigger__b.get<uint8_t>()) << 2 | uint64_t(top.p_line.get<uint8_t>()) << 3 |
           uint64_t(top.p_phases.get<uint8_t>()) << 4 | uint64_t(top.p_direction__a.get<uint8_t>()) << 7 |
           uint64_t(top.p_direction__b.get<uint8_t>()) << 8 | uint64_t(top.p_running.get<uint8_t>()) << 9 |
           uint64_t(top.p_substep.get<uint8_t>()) << 10;
}

enum Pin : uint64_t { LED = 1, TRIGGER_A = 2, TRIGGER_B = 4, LINE = 8, RUNNING = 512, SUBSTEP = 1024 };

static void end_substep(Twin &twin, Exchange &exchange) {
    if (twin.substep_clocks != 0) exchange.light[exchange.lit++] = 2 * twin.lit_clocks > twin.substep_clocks;
    twin.lit_clocks = twin.substep_clocks = 0;
}

static void end_line(Twin &twin) {
    if (twin.lines) twin.run.line_clocks = twin.clock - twin.line_began;
    twin.line_began = twin.clock;
}

static void count_pulse(Twin &twin, int arm, bool rises) {
    if (!rises) return;
    if (twin.run.pulses[arm]++ == 0) twin.run.delays[arm] = twin.clock - twin.line_began;
}

// One clock of the run as cameras and light see it; true where a run begins or ends.
static bool follow(Twin &twin, uint64_t before, uint64_t pins, Exchange &exchange) {
    twin.running_was = twin.running_was << 1 | ((pins & RUNNING) != 0);
    const bool running = twin.running_was >> PIN_CLOCKS & 1, turns = running != (twin.run.running != 0);
    if (turns && running) {
        twin.run = {twin.run.number + 1, 1, {0, 0}, 0, {0, 0}};
        twin.lines = false;
    } else if (turns) {
        end_substep(twin, exchange);
        end_line(twin);
        twin.run.running = 0;
    }
    const uint64_t rises = pins & ~before;
    if (pins & LINE) {  // before the pulses: one without delay comes with its line
        end_line(twin);
        twin.lines = true;
    }
    count_pulse(twin, 0, rises & TRIGGER_A);
    count_pulse(twin, 1, rises & TRIGGER_B);
    if (pins & SUBSTEP) end_substep(twin, exchange);
    if (running && (pins & SUBSTEP || twin.substep_clocks != 0)) {
        ++twin.substep_clocks;
        twin.lit_clocks += pins & LED;
    }
    return turns;
}

// One clock of the line towards the device; true when the next byte may begin.
static bool send(Twin &twin) {
    if (twin.send_bits == 0) return true;
    if (--twin.send_timer == 0) {
        twin.sending >>= 1;
        twin.send_timer = twin.divisor;
        if (--twin.send_bits == 0) twin.sending = 1;
        twin.top.p_rx.set<uint8_t>(twin.sending & 1);
    }
    return false;
}

static void begin_byte(Twin &twin, uint8_t byte) {
    twin.sending = uint32_t(byte) << 1 | 0x200;
    twin.send_bits = 10;
    twin.send_timer = twin.divisor;
    twin.top.p_rx.set<uint8_t>(0);
}

// One clock of the line from the device; true when `received` is a byte.
static bool receive(Twin &twin) {
    const bool line = twin.top.p_tx.get<uint8_t>();
    if (twin.receive_bits == 0) {
        if (!line) {
            twin.receive_bits = 10;
            twin.receive_timer = twin.divisor / 2;
            twin.received = 0;
        }
        return false;
    }
    if (--twin.receive_timer != 0) return false;
    twin.receive_timer = twin.divisor;
    twin.received |= uint32_t(line) << (10 - twin.receive_bits);
    return --twin.receive_bits == 0;
}

extern "C" {

Twin *twin_new(uint32_t divisor, uint32_t clock_hz, uint64_t serial) {
    Twin *twin = new Twin;
    twin->divisor = divisor;
    twin->top.p_given__clock__hz.set<uint32_t>(clock_hz);
    twin->top.p_given__serial.set<uint64_t>(serial);
    twin->top.p_rx.set<uint8_t>(1);
    twin->top.p_clear__to__send.set<uint8_t>(1);
    twin->top.p_clock__locked.set<uint8_t>(1);
    twin->top.step();
    return twin;
}

void twin_free(Twin *twin) { delete twin; }

uint64_t twin_clock(const Twin *twin) { return twin->clock; }

uint64_t twin_pins(const Twin *twin) { return look(twin->top); }

int twin_link_busy(const Twin *twin) { return twin->send_bits != 0 || twin->receive_bits != 0; }

// Inputs in the order of firmware.cxxrtl.INPUTS.
void twin_set(Twin *twin, uint32_t input, uint8_t level) {
    switch (input) {
        case 0: twin->top.p_pps.set<uint8_t>(level); break;
        case 1: twin->top.p_scene__gate.set<uint8_t>(level); break;
        case 2: twin->top.p_external__arm.set<uint8_t>(level); break;
        case 3: twin->top.p_strobe__a.set<uint8_t>(level); break;
        case 4: twin->top.p_strobe__b.set<uint8_t>(level); break;
        case 5: twin->top.p_clock__locked.set<uint8_t>(level); break;
        case 6: twin->top.p_clock__external.set<uint8_t>(level); break;
        case 7: twin->top.p_clear__to__send.set<uint8_t>(level); break;
    }
}

const Run *twin_latest(const Twin *twin) { return &twin->run; }

// Runs `clocks` clocks, fewer if a buffer is full or a run begins or ends.
uint64_t twin_run(Twin *twin, uint64_t clocks, Exchange *exchange) {
    Exchange &io = *exchange;
    io.taken = io.made = io.noted = io.lit = 0;
    const uint64_t end = twin->clock + clocks, begun = twin->clock;
    bool turns = false;
    while (twin->clock < end && !turns && io.made < io.outputs && (io.room == 0 || io.noted < io.room) &&
           io.lit < io.light_room) {
        if (send(*twin) && io.taken < io.inputs) begin_byte(*twin, io.input[io.taken++]);
        twin->top.prev_p_clk.set<uint8_t>(0);  // nothing happens at the falling edge: left out
        twin->top.p_clk.set<uint8_t>(1);
        twin->top.step();
        if (receive(*twin)) io.output[io.made++] = uint8_t(twin->received >> 1);
        const uint64_t pins = look(twin->top);
        turns = follow(*twin, twin->pins, pins, io);
        if (io.room != 0 && pins != twin->pins) io.changes[io.noted++] = {twin->clock, pins};
        twin->pins = pins;
        ++twin->clock;
    }
    return twin->clock - begun;
}
}
