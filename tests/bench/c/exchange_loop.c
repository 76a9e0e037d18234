/* The exchange of the control loop in plain C, for comparison: same deadlines, same frames, same waits, same law.
 *
 *     sleep until the absolute deadline -> SYNC -> wait for TPDO -> law -> RPDO -> one log record
 *
 * FOR THE VIRTUAL JOINT ONLY: it has no phases, no limits of motion, no faults and no supervisor.  It enables the
 * drive and holds the position that it finds, then switches the drive off.
 *
 * exchange_loop FD PRIORITY PERIOD_ns RECEIVE_ns CYCLES; struct setting on stdin; on stdout CYCLES rows of int64
 * [wake-up after the deadline, wait for the sample, work, enabled], times in ns, -1 for a wait without a sample.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <poll.h>
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "law_tick.h"

struct frame {
    uint32_t can_id;
    uint8_t length, padding[3], payload[8];
};

struct setting { /* doubles for the same reason as struct law */
    double sync_id, tpdo_id, rpdo_id, heartbeat_id, heartbeat_cycles;
    double status_at, position_at, control_at, target_at, rpdo_length;
    double position_radpcount, torque_Nmppermille, max_permille;
    struct law law;
};

#define LOG_BYTES 408 /* about what the control loop records each cycle */
#define LOG_RECORDS 16384

static char log_ring[LOG_RECORDS][LOG_BYTES];

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void send_frame(int fd, const struct frame *frame)
{
    while (send(fd, frame, sizeof *frame, MSG_DONTWAIT | MSG_NOSIGNAL) < 0 && errno == EINTR)
        ;
}

static int take_frame(int fd, struct frame *frame)
{
    ssize_t got;
    do
        got = recv(fd, frame, sizeof *frame, MSG_DONTWAIT | MSG_TRUNC);
    while (got < 0 && errno == EINTR);
    return got == sizeof *frame;
}

/* Everything that waits, up to the wanted frame; 1 if it came. */
static int drain(int fd, struct frame *frame, uint32_t wanted)
{
    while (take_frame(fd, frame))
        if (frame->can_id == wanted)
            return 1;
    return 0;
}

static int control_word(int status)
{
    if ((status & 0x4F) == 0x40)
        return 0x06;
    if ((status & 0x6F) == 0x21)
        return 0x07;
    if ((status & 0x6F) == 0x23 || (status & 0x6F) == 0x27)
        return 0x0F;
    return 0x00;
}

int main(int argc, char **argv)
{
    static struct setting k;
    static struct law_state state;
    if (argc != 6 || fread(&k, sizeof k, 1, stdin) != 1)
        return 2;
    int fd = atoi(argv[1]), priority = atoi(argv[2]);
    int64_t period_ns = atoll(argv[3]), receive_ns = atoll(argv[4]), cycles = atoll(argv[5]);
    int64_t(*times)[4] = calloc(cycles, sizeof *times);
    if (times == NULL)
        return 3;
    memset(log_ring, 1, sizeof log_ring);
    if (priority > 0) {
        struct sched_param parameter = {.sched_priority = priority};
        if (sched_setscheduler(0, SCHED_FIFO, &parameter) != 0)
            perror("exchange_loop: SCHED_FIFO");
    }
    mlockall(MCL_CURRENT | MCL_FUTURE);

    struct frame sync = {.can_id = (uint32_t)k.sync_id}, heartbeat = {.can_id = (uint32_t)k.heartbeat_id, .length = 1};
    struct frame rpdo = {.can_id = (uint32_t)k.rpdo_id, .length = (uint8_t)k.rpdo_length}, got;
    heartbeat.payload[0] = 5;
    uint32_t tpdo_id = (uint32_t)k.tpdo_id;
    int status_at = (int)k.status_at, position_at = (int)k.position_at;
    int control_at = (int)k.control_at, target_at = (int)k.target_at, heartbeat_cycles = (int)k.heartbeat_cycles;
    int status = 0;
    double position = 0.0, start = NAN;
    int64_t deadline_ns = now_ns() + period_ns;
    for (int64_t cycle = 0; cycle < cycles; cycle++) {
        struct timespec until = {deadline_ns / 1000000000LL, deadline_ns % 1000000000LL};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR)
            ;
        int64_t wake_ns = now_ns(), late_ns = wake_ns - deadline_ns;
        if (late_ns >= period_ns)
            deadline_ns += late_ns / period_ns * period_ns;
        drain(fd, &got, 0xFFFFFFFF);
        send_frame(fd, &sync);
        if (heartbeat_cycles > 0 && cycle % heartbeat_cycles == 0)
            send_frame(fd, &heartbeat);
        int64_t started_ns = now_ns(), arrived_ns = started_ns, give_up_ns = deadline_ns + receive_ns;
        int came;
        while (!(came = drain(fd, &got, tpdo_id)) && arrived_ns < give_up_ns) {
            int64_t left_ns = give_up_ns - arrived_ns;
            struct pollfd readable = {.fd = fd, .events = POLLIN};
            struct timespec wait = {left_ns / 1000000000LL, left_ns % 1000000000LL};
            ppoll(&readable, 1, &wait, NULL);
            arrived_ns = now_ns();
        }
        int64_t waited_ns = now_ns() - started_ns;
        if (came) {
            int32_t counts;
            uint16_t word;
            memcpy(&word, got.payload + status_at, 2);
            memcpy(&counts, got.payload + position_at, 4);
            status = word;
            position = counts * k.position_radpcount;
            if (isnan(start))
                start = position;
        }
        int enabled = (status & 0x6F) == 0x27;
        double torque = isnan(start) ? 0.0 : law_tick(&k.law, &state, position, start, 0.0, 0.0);
        double permille = fmin(fmax(torque / k.torque_Nmppermille, -k.max_permille), k.max_permille);
        int16_t target = enabled ? (int16_t)lround(permille) : 0;
        uint16_t command = cycle + 50 < cycles ? (uint16_t)control_word(status) : 0;
        memcpy(rpdo.payload + control_at, &command, 2);
        memcpy(rpdo.payload + target_at, &target, 2);
        send_frame(fd, &rpdo);
        int64_t end_ns = now_ns();
        memcpy(log_ring[cycle % LOG_RECORDS], &state, sizeof state);
        times[cycle][0] = late_ns;
        times[cycle][1] = came ? waited_ns : -1;
        times[cycle][2] = end_ns - wake_ns - waited_ns;
        times[cycle][3] = enabled;
        deadline_ns += period_ns;
    }
    fwrite(times, sizeof *times, cycles, stdout);
    return 0;
}
