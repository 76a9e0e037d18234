/* The exchange of the control loop in plain C, for comparison: same deadlines, frames, waits, law and model of the arm.
 *
 *     sleep until the absolute deadline -> SYNC -> wait for each TPDO -> arm's model, laws -> RPDOs -> log records
 *
 * FOR THE VIRTUAL JOINT AND ARM ONLY: it has no phases, no limits of motion, no faults and no supervisor.  It enables
 * the drives and swings about the positions that it finds, then switches the drives off.
 *
 * exchange_loop FD PRIORITY PERIOD_ns RECEIVE_ns CYCLES DRIVES; on stdin a struct setting of each drive, all on one
 * bus, then, of an arm, its gravity[3] and a struct link of each; on stdout CYCLES rows of int64 [wake-up after the
 * deadline, wait for the samples, work, all enabled, slots skipped], times in ns, -1 for a wait in which one did not
 * come.
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

#include "arm_model.h"
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
#define MOST_DRIVES MOST_LINKS
#define SWING_rad 0.1
#define SWING_radps 1.5 /* of the first drive; each of the others half a radian a second quicker */

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

struct drive {
    struct setting k;
    struct law_state law;
    struct frame rpdo;
    int status, came;
    double position, start;
};

static struct drive drives[MOST_DRIVES];
static struct link links[MOST_LINKS];
static struct motion motion[MOST_LINKS + 1];

/* The desired motion, from rest, and what the arm asks for beyond each joint's own inertia. */
static void plan(int count, int arm, double moving_s)
{
    for (int i = 0; i < count; i++) {
        double w = SWING_radps + 0.5 * i, phase = w * moving_s, step = moving_s > 0.0 ? SWING_rad * w : 0.0;
        motion[i].position = drives[i].start + SWING_rad * (1.0 - cos(phase));
        motion[i].velocity = step * sin(phase);
        motion[i].acceleration = step * w * cos(phase);
    }
    if (arm)
        newton_euler(links, motion, count);
    for (int i = 0; i < count; i++)
        motion[i].torque -= arm ? drives[i].k.law.inertia_kgm2 * motion[i].acceleration : 0.0;
}

/* Takes everything that waits. */
static void drain(int fd, int count)
{
    struct frame got;
    while (take_frame(fd, &got))
        for (int i = 0; i < count; i++) {
            struct drive *drive = &drives[i];
            if (got.can_id != (uint32_t)drive->k.tpdo_id)
                continue;
            int32_t counts;
            uint16_t word;
            memcpy(&word, got.payload + (int)drive->k.status_at, 2);
            memcpy(&counts, got.payload + (int)drive->k.position_at, 4);
            drive->status = word;
            drive->position = counts * drive->k.position_radpcount;
            if (isnan(drive->start))
                drive->start = drive->position;
            drive->came = 1;
        }
}

static int all_came(int count)
{
    for (int i = 0; i < count; i++)
        if (!drives[i].came)
            return 0;
    return 1;
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
    if (argc != 7)
        return 2;
    int fd = atoi(argv[1]), priority = atoi(argv[2]), count = atoi(argv[6]);
    int64_t period_ns = atoll(argv[3]), receive_ns = atoll(argv[4]), cycles = atoll(argv[5]);
    if (count < 1 || count > MOST_DRIVES)
        return 2;
    for (int i = 0; i < count; i++) {
        struct drive *drive = &drives[i];
        if (fread(&drive->k, sizeof drive->k, 1, stdin) != 1)
            return 2;
        drive->rpdo.can_id = (uint32_t)drive->k.rpdo_id;
        drive->rpdo.length = (uint8_t)drive->k.rpdo_length;
        drive->start = NAN;
    }
    double gravity[3];
    int arm = fread(gravity, sizeof gravity, 1, stdin) == 1;
    if (arm && fread(links, sizeof links[0], count, stdin) != (size_t)count)
        return 2;
    for (int k = 0; k < 3; k++)
        motion[count].pull[k] = arm ? -gravity[k] : 0.0;
    int64_t(*times)[5] = calloc(cycles, sizeof *times);
    if (times == NULL)
        return 3;
    memset(log_ring, 1, sizeof log_ring);
    if (priority > 0) {
        struct sched_param parameter = {.sched_priority = priority};
        if (sched_setscheduler(0, SCHED_FIFO, &parameter) != 0)
            perror("exchange_loop: SCHED_FIFO");
    }
    mlockall(MCL_CURRENT | MCL_FUTURE);

    const struct setting *first = &drives[0].k;
    struct frame sync = {.can_id = (uint32_t)first->sync_id};
    struct frame heartbeat = {.can_id = (uint32_t)first->heartbeat_id, .length = 1};
    heartbeat.payload[0] = 5;
    int heartbeat_cycles = (int)first->heartbeat_cycles;
    int64_t deadline_ns = now_ns() + period_ns;
    double moving_s = 0.0;
    for (int64_t cycle = 0; cycle < cycles; cycle++) {
        struct timespec until = {deadline_ns / 1000000000LL, deadline_ns % 1000000000LL};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR)
            ;
        int64_t wake_ns = now_ns(), late_ns = wake_ns - deadline_ns, skipped = late_ns / period_ns;
        deadline_ns += skipped * period_ns;
        drain(fd, count);
        for (int i = 0; i < count; i++)
            drives[i].came = 0;
        send_frame(fd, &sync);
        if (heartbeat_cycles > 0 && cycle % heartbeat_cycles == 0)
            send_frame(fd, &heartbeat);
        int64_t started_ns = now_ns(), arrived_ns = started_ns, give_up_ns = deadline_ns + receive_ns;
        while (drain(fd, count), !all_came(count) && arrived_ns < give_up_ns) {
            int64_t left_ns = give_up_ns - arrived_ns;
            struct pollfd readable = {.fd = fd, .events = POLLIN};
            struct timespec wait = {left_ns / 1000000000LL, left_ns % 1000000000LL};
            ppoll(&readable, 1, &wait, NULL);
            arrived_ns = now_ns();
        }
        int64_t waited_ns = now_ns() - started_ns;
        int enabled = 1;
        plan(count, arm, moving_s);
        for (int i = 0; i < count; i++) {
            struct drive *drive = &drives[i];
            const struct setting *k = &drive->k;
            int own = (drive->status & 0x6F) == 0x27;
            const struct motion *to = &motion[i];
            double torque = isnan(drive->start) ? 0.0
                                                : law_tick(&k->law, &drive->law, drive->position, to->position,
                                                           to->velocity, to->acceleration, to->torque);
            double permille = fmin(fmax(torque / k->torque_Nmppermille, -k->max_permille), k->max_permille);
            int16_t target = own ? (int16_t)lround(permille) : 0;
            uint16_t command = cycle + 50 < cycles ? (uint16_t)control_word(drive->status) : 0;
            memcpy(drive->rpdo.payload + (int)k->control_at, &command, 2);
            memcpy(drive->rpdo.payload + (int)k->target_at, &target, 2);
            enabled &= own;
        }
        moving_s += enabled ? 1e-9 * period_ns : 0.0;
        for (int i = 0; i < count; i++)
            send_frame(fd, &drives[i].rpdo);
        int64_t end_ns = now_ns();
        for (int i = 0; i < count; i++)
            memcpy(log_ring[(cycle * count + i) % LOG_RECORDS], &drives[i].law, sizeof drives[i].law);
        times[cycle][0] = late_ns;
        times[cycle][1] = all_came(count) ? waited_ns : -1;
        times[cycle][2] = end_ns - wake_ns - waited_ns;
        times[cycle][3] = enabled;
        times[cycle][4] = skipped;
        deadline_ns += period_ns;
    }
    fwrite(times, sizeof *times, cycles, stdout);
    return 0;
}
