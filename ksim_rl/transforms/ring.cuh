// One step of a row's ring, or its beginning.
//
// Rows of the ring are bytes, so that one kernel serves every dtype. The lanes of a row copy words of 16, 4 or 1 bytes,
// a few at once, as the GPU waits for all of them together; on the CPU one lane copies whole parts.
#pragma once
#include "ksim_rl/device/draws.cuh"

namespace ring {

using namespace draws;

struct Arguments {
    int width;  // bytes of a word; any other number copies whole parts
    int lanes;  // of a row
    int num_bytes;     // of a value
    int value_stride;  // bytes from the value of a row to the next value
    int num_slots;
    int num_frames;  // values that are returned
    int stride;      // steps from a frame to the one before it
    int num_parts;   // of a value
    int counts;      // whether the age goes on
    int first_row;   // of this rank
    unsigned stream;
    int lowest;  // of the lags that are drawn
    int span;    // how many lags there are
    const long long* seed;
    long long* draw_count;  // null where no lag is drawn
    long long* age;         // steps since the reset
    long long* lag;         // null where there is none
    const unsigned char* mask;  // the rows that reset; null in a step
    const int* parts;           // their bytes; null for one part
    const unsigned char* value;
    unsigned char* ring;
    unsigned char* out;
};

struct alignas(16) Wide {
    unsigned word[4];
};

// What the lanes of a row know of it.
struct Row {
    const unsigned char* value;
    unsigned char* ring;
    unsigned char* out;
    long long now;     // steps since the reset
    long long newest;  // the lag of the last frame
    long long stride;
    int slot;  // of the present value
    int num_slots, num_bytes, num_frames;
    bool writes;

    // Where the value of a frame lies. No lag reaches back beyond the reset.
    CUDA_CALLABLE const unsigned char* frame(int frame) const
    {
        const long long wanted = newest + (num_frames - 1 - frame) * stride;
        const int lag = (int)(wanted < now ? wanted : now), from = slot - lag;
        return lag == 0 ? value : ring + (long long)(from < 0 ? from + num_slots : from) * num_bytes;
    }
};

// All lanes of a row have to read the age before one of them counts on.
CUDA_CALLABLE inline void wait_for_row(int lanes)
{
#if defined(__CUDA_ARCH__)
    if (lanes == 32)
        __syncwarp();
    else
        __syncthreads();
#endif
}

CUDA_CALLABLE inline void draw_lag(int row, const Arguments& a)
{
    const long long count = ++a.draw_count[row];
    const RowKey key = key_of(*a.seed, a.stream, count, a.first_row + row);
    const unsigned long long bits = bits_of(key, 0u);
    a.lag[row] = a.lowest + (long long)((bits * (unsigned)a.span) >> 32);
}

template <class Word>
CUDA_CALLABLE inline void copy_words(int lane, const Row& row, const Arguments& a)
{
    const int AT_ONCE = 4;
    const int lanes = a.lanes;
    Word* slot_words = (Word*)(row.ring + (long long)row.slot * row.num_bytes);
    const int words_per_row = row.num_bytes / (int)sizeof(Word);
    if (row.writes)
        for (int word = lane; word < words_per_row; word += lanes)
            slot_words[word] = ((const Word*)row.value)[word];
    Word* to = (Word*)row.out;
    int offset = 0;
    for (int part = 0; part < a.num_parts; ++part) {
        const unsigned words = (a.parts ? a.parts[part] : row.num_bytes) / (unsigned)sizeof(Word);
        const int items = row.num_frames * (int)words;
        for (int begin = lane; begin < items; begin += AT_ONCE * lanes) {
            Word found[AT_ONCE];
#pragma unroll
            for (int k = 0; k < AT_ONCE; ++k) {
                const unsigned item = begin + k * lanes, frame = item / words;
                if (item < items)
                    found[k] = ((const Word*)row.frame(frame))[offset + item - frame * words];
            }
#pragma unroll
            for (int k = 0; k < AT_ONCE; ++k)
                if (begin + k * lanes < items)
                    to[begin + k * lanes] = found[k];
        }
        to += items;
        offset += words;
    }
}

CUDA_CALLABLE inline void copy_parts(const Row& row, const Arguments& a)
{
    if (row.writes)
        memcpy(row.ring + (long long)row.slot * row.num_bytes, row.value, row.num_bytes);
    for (int frame = 0; frame < row.num_frames; ++frame) {
        const unsigned char* from = row.frame(frame);
        int offset = 0;
        for (int part = 0; part < a.num_parts; ++part) {
            const int size = a.parts ? a.parts[part] : row.num_bytes;
            memcpy(row.out + offset * row.num_frames + frame * size, from + offset, size);
            offset += size;
        }
    }
}

CUDA_CALLABLE inline void run(int row, int lane, const Arguments& a)
{
    const int num_bytes = a.num_bytes, num_slots = a.num_slots, num_frames = a.num_frames;
    long long* age = a.age + row;
    const long long before = *age;
    wait_for_row(a.lanes);
    const bool resets = a.mask != nullptr;
    const bool writes = !resets || a.mask[row];
    const long long now = resets ? 0 : before + 1;
    if (lane == 0 && writes && a.counts)
        *age = now;
    if (lane == 0 && resets && writes && a.draw_count)
        draw_lag(row, a);
    Row own;
    // Whole numbers of 32 bits divide much faster.
    own.slot = now >> 32 ? (int)(now % (unsigned)num_slots) : (int)((unsigned)now % (unsigned)num_slots);
    own.newest = a.lag && !resets ? a.lag[row] : 0;
    own.stride = resets ? 0 : a.stride;
    own.ring = a.ring + (long long)row * num_slots * num_bytes;
    own.value = a.value + (long long)row * a.value_stride;
    own.out = a.out + (long long)row * num_frames * num_bytes;
    own.now = now;
    own.num_slots = num_slots;
    own.num_bytes = num_bytes;
    own.num_frames = num_frames;
    own.writes = writes;
    if (a.width == 16)
        copy_words<Wide>(lane, own, a);
    else if (a.width == 4)
        copy_words<unsigned>(lane, own, a);
    else if (a.width == 1)
        copy_words<unsigned char>(lane, own, a);
    else
        copy_parts(own, a);
}

}
