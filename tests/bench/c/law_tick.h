/* The control law of spec (29) with LuGre friction on the desired velocity, as the kernels of firmware_py compute it.
 *
 * Written to be compared with them: same operations in the same order, same memory per tick, no phases.
 * SI units; torques at the joint unless the name says motor.  Every field is a double, so that numpy can fill the
 * structures as flat arrays (tests/bench/c_programs.py has the same order).
 */
#ifndef LAW_TICK_H
#define LAW_TICK_H

#include <math.h>

#define NEURONS 15

struct branch {
    double coulomb_Nm, static_Nm, stribeck_speed_radps, viscous_Nmspr;
    double cubic[4];
    double knee_radps, max_radps;
};

struct law {
    double period_s, inertia_kgm2, coriolis_Nmspr, gravity_Nm, gravity_zero_rad, kp, kv, reduction_ratio;
    double stiffness_Nmprad, damping_Nmspr;
    double filter_gain, learning_rate, leakage, weight_limit, dead_zone_rad;
    double torque_max_Nm, torque_rate_max_Nmps;
    double p_b[2];
    struct branch positive, negative;
    double centres[NEURONS][2];
    double inverse_width[NEURONS];
};

struct law_state {
    double primed, last_position_rad, velocity_radps, last_error_rad, error_rate_radps;
    double deflection_rad, sent_torque_Nm;
    double inertia_torque_Nm, feedback_torque_Nm, friction_torque_Nm, gravity_torque_Nm, network_torque_Nm;
    double weights[NEURONS], hidden[NEURONS];
};

static inline double branch_torque_Nm(const struct branch *b, double speed)
{
    if (speed <= b->knee_radps)
        return b->coulomb_Nm + (b->static_Nm - b->coulomb_Nm) * exp(-speed / b->stribeck_speed_radps)
               + b->viscous_Nmspr * speed;
    const double *a = b->cubic;
    double u = speed < b->max_radps ? speed : b->max_radps;
    double torque = a[0] + u * (a[1] + u * (a[2] + u * a[3]));
    if (speed > b->max_radps)
        torque += (speed - u) * (a[1] + u * (2.0 * a[2] + 3.0 * u * a[3]));
    return torque;
}

static inline double lugre_torque_Nm(const struct law *k, struct law_state *s, double velocity)
{
    double speed = fabs(velocity);
    if (speed == 0.0)
        return k->stiffness_Nmprad * s->deflection_rad;
    double sliding = k->reduction_ratio * branch_torque_Nm(velocity > 0.0 ? &k->positive : &k->negative, speed);
    double settled = copysign(sliding / k->stiffness_Nmprad, velocity);
    double decay = exp(-speed * k->period_s * k->stiffness_Nmprad / sliding);
    double moved = settled + (s->deflection_rad - settled) * decay;
    double rate = (moved - s->deflection_rad) / k->period_s;
    s->deflection_rad = moved;
    return k->stiffness_Nmprad * moved + k->damping_Nmspr * rate;
}

static inline double network_torque_Nm(const struct law *k, struct law_state *s, double error, double error_rate)
{
    double output = 0.0;
    for (int i = 0; i < NEURONS; i++) {
        double d1 = error - k->centres[i][0], d2 = error_rate - k->centres[i][1];
        s->hidden[i] = exp(-(d1 * d1 + d2 * d2) * k->inverse_width[i]);
    }
    for (int i = 0; i < NEURONS; i++)
        output += s->weights[i] * s->hidden[i];
    return output;
}

static inline void adapt_network(const struct law *k, struct law_state *s, double error, double error_rate)
{
    if (fabs(error) < k->dead_zone_rad)
        return;
    double gain = k->learning_rate * (error * k->p_b[0] + error_rate * k->p_b[1]) * k->period_s;
    double keep = 1.0 - k->leakage * k->period_s, limit = k->weight_limit;
    for (int i = 0; i < NEURONS; i++)
        s->weights[i] = keep * s->weights[i] + gain * s->hidden[i];
    if (limit > 0.0)
        for (int i = 0; i < NEURONS; i++)
            s->weights[i] = fmin(fmax(s->weights[i], -limit), limit);
}

/* Measured position and desired motion to the limited torque [Nm]; arm_torque: what an arm asks for beyond the joint's
 * own inertia. */
static inline double law_tick(const struct law *k, struct law_state *s, double position, double desired_position,
                              double desired_velocity, double desired_acceleration, double arm_torque)
{
    double error = position - desired_position;
    if (s->primed == 0.0) {
        s->primed = 1.0;
        s->velocity_radps = 0.0;
        s->error_rate_radps = 0.0;
    } else {
        s->velocity_radps += k->filter_gain * ((position - s->last_position_rad) / k->period_s - s->velocity_radps);
        s->error_rate_radps += k->filter_gain * ((error - s->last_error_rad) / k->period_s - s->error_rate_radps);
    }
    s->last_position_rad = position;
    s->last_error_rad = error;
    s->inertia_torque_Nm = k->inertia_kgm2 * desired_acceleration + arm_torque;
    s->feedback_torque_Nm = -k->inertia_kgm2 * (k->kv * s->error_rate_radps + k->kp * error);
    s->gravity_torque_Nm = k->coriolis_Nmspr * s->velocity_radps + k->gravity_Nm * sin(position - k->gravity_zero_rad);
    s->friction_torque_Nm = lugre_torque_Nm(k, s, desired_velocity);
    s->network_torque_Nm = network_torque_Nm(k, s, error, s->error_rate_radps);
    adapt_network(k, s, error, s->error_rate_radps);
    double torque = s->inertia_torque_Nm + s->feedback_torque_Nm + s->gravity_torque_Nm + s->friction_torque_Nm
                    - s->network_torque_Nm;
    if (!isfinite(torque)) {
        s->sent_torque_Nm = 0.0;
        return 0.0;
    }
    double step = k->torque_rate_max_Nmps * k->period_s;
    torque = fmin(fmax(torque, -k->torque_max_Nm), k->torque_max_Nm);
    torque = fmin(fmax(torque, s->sent_torque_Nm - step), s->sent_torque_Nm + step);
    s->sent_torque_Nm = torque;
    return torque;
}

#endif
