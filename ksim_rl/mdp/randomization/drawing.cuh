// Draws entries of a model field in one world; the lanes of a world share them.
#pragma once
#include "ksim_rl/device/draws.cuh"

namespace drawing {

using namespace draws;

struct Arguments {
    int elements;
    int columns;
    int shared;     // whether a column has one draw for all elements
    int kind;       // 0 to 2: uniform, uniform in the logarithm, and normal
    int operation;  // 0 to 2: of the draw, of the model's own value and the draw the sum, and their product
    float cut;      // where a normal ends, in deviations
    int lanes;      // of a world
    int world_stride;
    int element_stride;
    int followers;  // columns of the follower
    int counter_stride;
    int first_row;  // of this rank
    unsigned stream;
    const long long* seed;
    const long long* counter;
    const unsigned char* mask;  // null for all worlds
    const float* table;
    float* field;
    float* follower;
};

// The parts of the table, one behind the other.
struct Table {
    const float* first;   // the low ends of the columns, or means
    const float* second;  // their high ends, or deviations
    const float* places;  // of the columns in an element of the field
    const float* ids;     // of the elements
    const float* own;     // the model's own values
    const float* ratios;  // of the follower to the drawn value
};

CUDA_CALLABLE inline Table table_of(const Arguments& a)
{
    Table table;
    table.first = a.table;
    table.second = table.first + a.columns;
    table.places = table.second + a.columns;
    table.ids = table.places + a.columns;
    table.own = table.ids + a.elements;
    table.ratios = table.own + a.elements * a.columns;
    return table;
}

// A draw of a column, by the bits of its coordinates.
CUDA_CALLABLE inline float drawn(unsigned bits, int column, const Table& table, const Arguments& a)
{
    const bool is_log = a.kind == 1, is_normal = a.kind == 2;
    const float sample = is_normal ? wp::clamp(normal(bits), -a.cut, a.cut) : unit(bits);
    const float low = is_log ? wp::log(table.first[column]) : table.first[column];
    const float high = is_log ? wp::log(table.second[column]) : table.second[column];
    const float sum = low + (is_normal ? high : high - low) * sample;
    return is_log ? wp::exp(sum) : sum;
}

CUDA_CALLABLE inline void draw_world(int row, int lane, const Arguments& a)
{
    const Table table = table_of(a);
    const long long count = a.counter[row * a.counter_stride];
    const RowKey key = key_of(*a.seed, a.stream, count, a.first_row + row);
    for (int item = lane; item < a.elements * a.columns; item += a.lanes) {
        const int element = item / a.columns, column = item - element * a.columns;
        const unsigned bits = bits_of(key, (unsigned)(a.shared ? column : item));
        const float draw = drawn(bits, column, table, a), own = table.own[item];
        const float value = a.operation == 0 ? draw : a.operation == 1 ? own + draw : own * draw;
        const int id = (int)table.ids[element];
        a.field[(long long)row * a.world_stride + id * a.element_stride + (int)table.places[column]] = value;
        // A field that grows in proportion to the only column that is drawn.
        const long long place = (long long)row * (a.world_stride / a.element_stride) + id;
        float* follower = a.follower + place * a.followers;
        for (int i = 0; i < a.followers; ++i)
            follower[i] = table.ratios[element * a.followers + i] * value;
    }
}

CUDA_CALLABLE inline void run(int row, int lane, const Arguments& a)
{
    if (!a.mask || a.mask[row])
        draw_world(row, lane, a);
}

}
