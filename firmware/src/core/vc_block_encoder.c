/* Encoder of blocks: a search for the levels of least distortion + lambda * rate, then the decoder's steps mirrored;
 * see vc_block_coder.h. */
#include "vc_block_coder.h"
#include "vc_mdct_mixing.h"

#define STATES 4
#define UNREACHED INT64_MAX
#define MAX_DIFFERENCE (1 << 27)

/* The best way into a state of dependent quantisation after one bin. */
typedef struct {
    int64_t cost; /* squared error + lambda * rate, in 1/65536 of a squared step */
    vc_below below;
} path;

/* Context of the search for one block. */
typedef struct {
    vc_model *model;
    const vc_history *history;
    vc_block_search *search;
    uint32_t bins, lambda;
} task;

/* Probabilities, in 1/65536, of the decisions up to `last`, before the model learns from this block. */
static void estimate(const task *task, const vc_contexts *contexts, unsigned quantiser, uint32_t last,
                     uint32_t *probabilities)
{
    vc_prediction prediction;
    unsigned decision;
    for (decision = 0; decision < VC_KINDS && decision <= last; decision++)
        probabilities[decision] = vc_predict(task->model, contexts, decision, quantiser, &prediction);
}

/* Estimated rate of an index in 1/256 bit. */
static int64_t estimated_cost(const uint32_t *probabilities, uint32_t index)
{
    int64_t cost = index > 0 ? 256 : 0;
    uint32_t decision;
    for (decision = 0; decision <= index && decision < VC_UNARY_LIMIT; decision++) {
        uint32_t probability = probabilities[decision < VC_KINDS ? decision : VC_KINDS - 1] >> 5;
        cost += vc_cost[index > decision ? probability : 2047 - probability];
    }
    if (index >= VC_UNARY_LIMIT)
        cost += 256 * (1 + 2 * (int64_t)vc_floor_log2(index - VC_UNARY_LIMIT + 1));
    return cost;
}

/* Squared difference of a magnitude and its reconstruction (in 1/256 step), in 1/65536 of a squared step. */
static int64_t distortion(uint32_t magnitude, int64_t reconstruction)
{
    int64_t difference = (int64_t)magnitude - reconstruction;
    if (difference > MAX_DIFFERENCE) /* so that the sum over a block stays below 2^62 */
        difference = MAX_DIFFERENCE;
    return difference * difference;
}

/* Extends one path by bin k, trying the indices around the magnitude and zero. */
static void extend(const task *task, uint32_t k, uint32_t magnitude, unsigned state, const path *from, path *paths)
{
    const unsigned quantiser = vc_quantiser_of(state);
    const uint32_t nearest = (magnitude / 256 + quantiser) / 2;
    uint32_t candidates[4], probabilities[VC_KINDS];
    unsigned count = 0, i;
    vc_contexts contexts;
    vc_contexts_find(&contexts, &task->search->bin[k], k, &from->below);
    estimate(task, &contexts, quantiser, nearest + 1, probabilities);
    candidates[count++] = nearest;
    candidates[count++] = nearest + 1;
    if (nearest > 0)
        candidates[count++] = nearest - 1;
    if (nearest == 2)
        candidates[count++] = 0;
    for (i = 0; i < count; i++) {
        uint32_t index = candidates[i], level = vc_level_of(index, quantiser);
        unsigned next = vc_next_state(state, index);
        const int64_t reconstruction =
            (int64_t)level * 256 + vc_level_offset(task->model, quantiser, contexts.centroid_class, level);
        int64_t cost =
            from->cost + distortion(magnitude, reconstruction) + task->lambda * estimated_cost(probabilities, index);
        if (cost < paths[next].cost) {
            paths[next].cost = cost;
            paths[next].below = from->below;
            vc_below_add(&paths[next].below, task->history, k, vc_kept_magnitude(level));
            task->search->chosen[k][next] = index;
            task->search->origin[k][next] = (uint8_t)state;
        }
    }
}

/* Chooses the indices of one block by a Viterbi search from a state of dependent quantisation. Returns 1 if silence is
 * the best choice for the block. */
static int search_block(const task *task, unsigned first_state, const uint32_t *magnitudes)
{
    const uint32_t silence = vc_silence_predict(task->model, task->history) >> 5;
    path paths[2][STATES];
    path *now = paths[0], *next = paths[1];
    int64_t silent_cost = (int64_t)task->lambda * vc_cost[silence];
    uint32_t k, largest = 0, any = 0;
    unsigned state, best = 0;
    for (k = 0; k < task->bins; k++)
        if (magnitudes[k] > largest)
            largest = magnitudes[k];
    if (largest < 128)
        return 1;
    for (k = 0; k < task->bins; k++)
        vc_bin_find(&task->search->bin[k], task->history, task->bins, k);
    for (state = 0; state < STATES; state++)
        now[state].cost = UNREACHED;
    now[first_state].cost = (int64_t)task->lambda * vc_cost[2047 - silence];
    memset(&now[first_state].below, 0, sizeof now[first_state].below);
    for (k = 0; k < task->bins; k++) {
        path *swap = now;
        silent_cost += distortion(magnitudes[k], 0);
        for (state = 0; state < STATES; state++)
            next[state].cost = UNREACHED;
        for (state = 0; state < STATES; state++)
            if (now[state].cost != UNREACHED)
                extend(task, k, magnitudes[k], state, &now[state], next);
        now = next;
        next = swap;
    }
    for (state = 1; state < STATES; state++)
        if (now[state].cost < now[best].cost)
            best = state;
    if (silent_cost < now[best].cost)
        return 1;
    for (k = task->bins; k-- > 0; best = task->search->origin[k][best]) {
        task->search->indices[k] = task->search->chosen[k][best];
        any |= task->search->indices[k];
    }
    return any == 0;
}

static void encode_decision(vc_range_coder *coder, vc_model *model, const vc_contexts *contexts, unsigned decision,
                            unsigned quantiser, int bit)
{
    vc_prediction prediction;
    vc_range_encode(coder, bit, vc_predict(model, contexts, decision, quantiser, &prediction));
    vc_update(&prediction, bit);
}

static void encode_index(vc_range_coder *coder, vc_model *model, const vc_contexts *contexts, unsigned quantiser,
                         uint32_t index)
{
    uint32_t decision;
    for (decision = 0; decision <= index && decision < VC_UNARY_LIMIT; decision++)
        encode_decision(coder, model, contexts, decision, quantiser, index > decision);
    if (index >= VC_UNARY_LIMIT)
        vc_golomb_encode(coder, index - VC_UNARY_LIMIT);
}

/* Writes the block of search->indices, with the signs of `values`. */
static void write_block(vc_range_coder *coder, vc_model *model, vc_block_state *state, vc_block_search *search,
                        uint32_t bins, const uint32_t *magnitudes, const int32_t *values, int silent)
{
    vc_history *history = &state->history;
    vc_below below = {{0, 0, 0}, 0, 0};
    vc_contexts contexts;
    vc_bin bin;
    uint32_t k;
    vc_range_encode(coder, silent, vc_silence_predict(model, history));
    vc_silence_update(model, history, silent);
    history->silent_history = (uint8_t)((history->silent_history << 1 | silent) & 3);
    if (silent)
        state->state = 0;
    for (k = 0; k < bins && !silent; k++) {
        unsigned quantiser = vc_quantiser_of(state->state);
        uint32_t index = search->indices[k], level = vc_level_of(index, quantiser);
        vc_bin_find(&bin, history, bins, k);
        vc_contexts_find(&contexts, &bin, k, &below);
        search->offsets[k] = vc_level_offset(model, quantiser, contexts.centroid_class, level);
        if (search->sums != NULL && magnitudes != NULL && level > 0) {
            const unsigned row = (level < VC_CENTROID_LEVELS ? level : VC_CENTROID_LEVELS) - 1;
            search->sums->sum[quantiser][row][contexts.centroid_class] += (int64_t)magnitudes[k] - (int64_t)level * 256;
            search->sums->count[quantiser][row][contexts.centroid_class]++;
        }
        encode_index(coder, model, &contexts, quantiser, index);
        if (index != 0)
            vc_range_encode(coder, values[k] < 0, VC_EVEN_ODDS);
        state->state = vc_next_state(state->state, index);
        vc_below_add(&below, history, k, vc_history_set(history, k, level));
    }
    vc_history_next_block(history, bins);
}

void vc_block_encode(vc_range_coder *coder, vc_model *model, vc_block_state *state, vc_block_search *search,
                     uint32_t bins, const uint32_t *magnitudes, const int32_t *values, uint32_t lambda)
{
    const task task = {model, &state->history, search, bins, lambda};
    write_block(coder, model, state, search, bins, magnitudes, values, search_block(&task, state->state, magnitudes));
}

void vc_block_write(vc_range_coder *coder, vc_model *model, vc_block_state *state, vc_block_search *search,
                    uint32_t bins, const int32_t *levels, int silent)
{
    unsigned now = state->state;
    uint32_t k;
    for (k = 0; k < bins; k++) {
        const uint32_t level = (uint32_t)(levels[k] < 0 ? -levels[k] : levels[k]);
        search->indices[k] = level == 0 ? 0 : (level + vc_quantiser_of(now)) / 2;
        now = vc_next_state(now, search->indices[k]);
    }
    write_block(coder, model, state, search, bins, NULL, levels, silent);
}
