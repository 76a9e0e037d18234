/* The law over many ticks, for timing, and the arm's model: a shared library called through ctypes. */
#include "arm_model.h"
#include "law_tick.h"

/* inputs[ticks][4]: position, desired position, velocity, acceleration; torque_Nm[ticks] is written. */
void run_ticks(const struct law *k, struct law_state *s, const double *inputs, double *torque_Nm, long ticks)
{
    for (long i = 0; i < ticks; i++)
        torque_Nm[i] = law_tick(k, s, inputs[4 * i], inputs[4 * i + 1], inputs[4 * i + 2], inputs[4 * i + 3], 0.0);
}

/* The 15 exponentials of the network alone: where the time of a tick goes. */
void run_hidden(const struct law *k, struct law_state *s, const double *inputs, double *torque_Nm, long ticks)
{
    for (long i = 0; i < ticks; i++)
        torque_Nm[i] = network_torque_Nm(k, s, inputs[4 * i] - inputs[4 * i + 1], inputs[4 * i + 2]);
}

/* motions[count][4]: position, velocity, acceleration, and the torque, which is written. */
void arm_torques(const struct link *links, const double *gravity, double *motions, long count)
{
    struct motion motion[MOST_LINKS + 1] = {0};
    for (int k = 0; k < 3; k++)
        motion[count].pull[k] = -gravity[k];
    for (long i = 0; i < count; i++)
        for (int k = 0; k < 3; k++)
            (&motion[i].position)[k] = motions[4 * i + k];
    newton_euler(links, motion, (int)count);
    for (long i = 0; i < count; i++)
        motions[4 * i + 3] = motion[i].torque;
}

long link_doubles(void) { return sizeof(struct link) / sizeof(double); }
long law_doubles(void) { return sizeof(struct law) / sizeof(double); }
long state_doubles(void) { return sizeof(struct law_state) / sizeof(double); }
